"""Damage to logs: in their columns, and in their bytes; in every format."""

from collections.abc import Callable
from random import Random

import numpy as np

from damage.case import FORMATS, Case, save, table
from damage.values import BYTES

Kind = Callable[[Case, Random], None]


def _pick(case: Case, rng: Random) -> tuple[dict[str, np.ndarray], str]:
    columns = case.logs[rng.choice(sorted(case.logs))]
    return columns, rng.choice(sorted(columns))


def dropped(case: Case, rng: Random) -> None:
    columns, name = _pick(case, rng)
    del columns[name]


def renamed(case: Case, rng: Random) -> None:
    columns, name = _pick(case, rng)
    columns[rng.choice((name + " ", name.upper(), "ü", "", "x" * 300, name + "[0]", "file", "a/b", "\n"))] = (
        columns.pop(name)
    )


def numbers(case: Case, rng: Random) -> None:
    """A run of rows holds something else."""
    columns, name = _pick(case, rng)
    values = np.array(columns[name], float)
    a = rng.randrange(len(values))
    b = rng.choice((a + 1, a + 5, len(values)))
    values[a:b] = rng.choice((np.nan, np.inf, -np.inf, 0.0, 1e300, -1e300, 1e-300, 1e18, 57.3, 1.7e308))
    columns[name] = values


def sizes(case: Case, rng: Random) -> None:
    """A whole column is multiplied or shifted."""
    columns, name = _pick(case, rng)
    columns[name] = columns[name] * rng.choice((0, -1, 1e-300, 1e300, 57.29578, 1e9, 1e-9, 1e3)) + rng.choice(
        (0, 0, 1e9, -1e300)
    )


def times(case: Case, rng: Random) -> None:
    columns = case.logs[rng.choice(sorted(case.logs))]
    t, how = np.array(columns["t"]), rng.randrange(9)
    i, j = sorted((rng.randrange(len(t)), rng.randrange(len(t))))
    if how == 0:
        t[i], t[j] = t[j], t[i]
    elif how == 1:
        t[i:] -= rng.choice((0.02, 0.5, 1e9))
    elif how == 2:
        t[i:] += rng.choice((0.1, 1.0, 1e9, 1e300))
    elif how == 3:
        t = t[::-1]
    elif how == 4:
        t = np.zeros_like(t)
    elif how == 5:
        t = np.round(t, 1)
    elif how == 6:
        t = (1.7e18 + 1e9 * t).astype(np.int64)
    elif how == 7:
        t = t * rng.choice((1e-12, 1e-6, 1e6, 1e300))
    else:
        t = np.cumsum(np.exp([rng.gauss(0, 3) for _ in t])) * 0.01
    columns["t"] = t


def types(case: Case, rng: Random) -> None:
    columns, name = _pick(case, rng)
    v = np.asarray(columns[name])
    n = len(v)
    made = (
        lambda: v.astype(np.float16), lambda: v.astype(np.int8), lambda: v > 0, lambda: v.astype("U12"),
        lambda: v.astype("S12"),
        lambda: v.astype(complex), lambda: np.array(1.0), lambda: np.zeros(0), lambda: v[:1], lambda: v[: n // 2],
        lambda: np.concatenate([v, v]), lambda: v[:, None], lambda: v[None], lambda: np.zeros((n, 3)),
        lambda: np.zeros((n, 0)),
        lambda: np.zeros((2, n, 2)), lambda: np.array(["", "a", "1"] * n)[:n],
        lambda: np.arange(n).astype("datetime64[s]"),
        lambda: np.arange(n).astype("timedelta64[ms]"), lambda: np.array([None, 1.0, "x"] * n, object)[:n],
        lambda: np.array([[1.0], [1.0, 2.0]] * n, object)[:n], lambda: v.astype(">f8"), lambda: v.astype(np.longdouble),
        lambda: np.full(n, 2**64 - 1, np.uint64), lambda: np.zeros(n, [("a", float), ("b", int)]),
        lambda: np.array("text"),
    )  # fmt: skip
    columns[name] = rng.choice(made)()


def lengths(case: Case, rng: Random) -> None:
    """Every column of a log, or of all, is short."""
    rows = rng.choice((0, 1, 2, 3, 5, 9, 12, 25))
    for stem in rng.sample(sorted(case.logs), rng.randint(1, 3)):
        case.logs[stem] = {k: v[:rows] for k, v in case.logs[stem].items()}


def files(case: Case, rng: Random) -> None:
    """Files that are missing, more, or the same."""
    how = rng.randrange(4)
    if how == 0:
        for stem in rng.sample(sorted(case.logs), rng.randint(1, 3)):
            del case.logs[stem]
    elif how == 1:
        case.logs = {f"run_{i}": table(0) for i in range(rng.randint(1, 6))}
    elif how == 2:
        case.logs[f"run_{rng.choice(('ü', ' ', 'x' * 200, '0.1', '-', '[1]'))}"] = table(7)
    else:
        case.extra[f"run_9.{case.suffix}"] = rng.choice((b"", b"x", b"\0" * 100))


def rotations(case: Case, rng: Random) -> None:
    for columns in case.logs.values():
        scale = rng.choice((0.0, 1e-200, 1e200, 0.5, -1.0, 1.0, np.nan))
        row = rng.randrange(len(columns["t"]))
        for name in ("qw", "qx", "qy", "qz"):
            columns[name] = np.array(columns[name])
            columns[name][row:] *= scale
        if rng.random() < 0.3:
            columns["qw"], columns["qz"] = columns["qz"], columns["qw"]


def contents(case: Case, rng: Random) -> None:
    """The bytes of a file."""
    name = f"{rng.choice(sorted(case.logs))}.{case.suffix}"
    damage = BYTES[rng.choice(list(BYTES))]
    case.edits[name] = lambda content: damage(content, rng)


def disguised(case: Case, rng: Random) -> None:
    """A file of another format under this one's name."""
    from pathlib import Path
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as folder:
        path = Path(folder) / f"log.{rng.choice(FORMATS)}"
        save(path, table(1))
        content = path.read_bytes()
    case.edits[f"{rng.choice(sorted(case.logs))}.{case.suffix}"] = lambda _: content


def csv_text(case: Case, rng: Random) -> None:
    """What people and spreadsheets do to tables."""
    case.suffix = "csv"
    old, new = rng.choice(
        ((",", ";"), (",", "\t"), (",", " "), (".", ","), ("\n", "\r"), ("\n", "\r\n"), ("\n", "\n\n"), ("0", "O"),
        ("-", "−"),
         ("\n", ",\n"), ("\n", "\n,"), ("t,", "t,t,"), ("t,", '"t,'), ("t,", ",,"), ("\n0.1", '\n"0.1'), ("\n",
         "\n# "), ("e-", "E-"),
         ("t,goal", "# t,goal"), ("\n", "\0\n"), ("1", "１"), ("0.", "0x"), ("t,goal", "\ufefft,goal"), ("0.5",
         "1" * 5000), ("0.5", "#NAME?"))
    )  # fmt: skip
    count = rng.choice((1, 3, 10**6))
    case.edits[f"{rng.choice(sorted(case.logs))}.csv"] = lambda content: (
        content.decode().replace(old, new, count).encode()
    )


def npz_headers(case: Case, rng: Random) -> None:
    """Arrays that claim to be larger, or of another kind, than their bytes are."""
    import io
    import zipfile

    header = str({
        "descr": rng.choice(("<f8", "|O", "<U9", "|V8", "<f9", "", [("a", "<f8")], "<c16", "<M8[s]")),
        "fortran_order": rng.choice((False, True, 3)),
        "shape": rng.choice(((10**12,), (60,), (), (-1,), (2**63,), (60, 10**9), "60", (60.5,), (0,))),
    })  # fmt: skip
    header = rng.choice((header, header[:20], "{'__import__'}", "(" * 300, ""))
    text = header.encode() + b" " * 10 + b"\n"
    member = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(8 * 60)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in table(0):
            archive.writestr(f"{name}{rng.choice(('.npy', '.npy', '', '.txt'))}", member)
    case.suffix = "npz"
    case.edits[f"{rng.choice(sorted(case.logs))}.npz"] = lambda _: buffer.getvalue()


LOGS: dict[str, Kind] = {
    f"log: {f.__name__.replace('_', ' ')}": f
    for f in (
        dropped,
        renamed,
        numbers,
        sizes,
        times,
        types,
        lengths,
        files,
        rotations,
        contents,
        disguised,
        csv_text,
        npz_headers,
    )
}
