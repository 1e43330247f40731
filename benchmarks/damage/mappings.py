"""Damage to mapping files: in their data, and in their text."""

from collections.abc import Callable, Iterator
from random import Random
from typing import Any

import yaml

from damage.case import Case
from damage.values import BYTES, odd

Kind = Callable[[Case, Random], None]


def places(data: Any, path: tuple = ()) -> Iterator[tuple]:
    """Every place of nested lists and dicts, from the root."""
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from places(value, (*path, key))


def _parent(data: Any, place: tuple) -> Any:
    for step in place[:-1]:
        data = data[step]
    return data


def _pick(case: Case, rng: Random) -> tuple[Any, Any]:
    place = rng.choice(list(places(case.mapping)))
    return _parent(case.mapping, place), place[-1]


def missing(case: Case, rng: Random) -> None:
    parent, key = _pick(case, rng)
    del parent[key]


def value(case: Case, rng: Random) -> None:
    parent, key = _pick(case, rng)
    parent[key] = odd(rng)


def several(case: Case, rng: Random) -> None:
    for _ in range(rng.randint(2, 5)):
        value(case, rng)


def extra(case: Case, rng: Random) -> None:
    parent, _ = _pick(case, rng)
    if isinstance(parent, dict):
        parent[str(odd(rng))] = odd(rng)
    else:
        parent.append(odd(rng))


def renamed(case: Case, rng: Random) -> None:
    parent, key = _pick(case, rng)
    if isinstance(parent, dict):
        at = rng.randrange(len(key) + 1)
        parent[key[:at] + rng.choice(("", "s", "_", " ", "ü")) + key[at + 1 :]] = parent.pop(key)


def exchanged(case: Case, rng: Random) -> None:
    (a, i), (b, j) = _pick(case, rng), _pick(case, rng)
    a[i], b[j] = b[j], a[i]


def numbers(case: Case, rng: Random) -> None:
    """A number of another size or sign: ranges, bounds, fractions, lengths, rates."""
    spots = [p for p in places(case.mapping) if isinstance(_parent(case.mapping, p)[p[-1]], int | float)]
    for _ in range(rng.randint(1, 3)):
        place = rng.choice(spots)
        parent = _parent(case.mapping, place)
        parent[place[-1]] = rng.choice((-1, 0, 1e-9, 1e-3, 0.5, 1.5, 7, 1e3, 1e6, 1e9, 1e15)) * (
            rng.choice((1, parent[place[-1]] or 1))
        )


def splits(case: Case, rng: Random) -> None:
    case.mapping["split"] = {
        "by": rng.choice(("log", "group", "time", "rotate", "fold", "", None, 3)),
        "fit": rng.choice((0.6, 1.0, 0.0, -0.2, 1.2)),
        "select": rng.choice((0.2, 0.0, 1.0, 0.4)),
        "verify": rng.choice((0.2, 0.0, 0.4, "0.2")),
        "seed": rng.choice((0, -1, 1.5, 2**70, "a")),
    }
    case.mapping["logs"] = [
        {
            "path": f"run_{rng.choice('0123*?')}.npz",
            rng.choice(("split", "group", "splits", "path")): rng.choice(
                ("fit", "select", "verify", "auto", "test", "(\\d+)", "\\d+", "((", "run_(x)", "splits.json", "", None)
            ),
        }
        for _ in range(rng.randint(1, 4))
    ]
    case.extra["splits.json"] = rng.choice(
        (b"{}", b"[]", b"", b"{", b'{"run_0": "fit", "run_1": "select", "run_2": "verify"}', b'{"run_0": 1}', b"\xff",
         b'{"run_0": "a", "run_1": "b", "run_2": "a", "run_9": "c"}', b"[" * 5000)
    )  # fmt: skip


def names(case: Case, rng: Random) -> None:
    """Names that the model or the logs do not have."""
    text = yaml.safe_dump(case.mapping, sort_keys=False)
    old = rng.choice(
        ("hinge", "servo", "base", "gyro", "bob", "rotor", "goal", "run_*", "body_mass", "dof_armature", "volts")
    )
    case.mapping = text.replace(
        old, rng.choice((f"{old}s", "", "ü", "a:b", "world", "weight", "imu", "root", "../x", "x y"))
    )


def text_bytes(case: Case, rng: Random) -> None:
    damage = BYTES[rng.choice(list(BYTES))]
    case.edits["mapping.yaml"] = lambda content: damage(content, rng)


def text_lines(case: Case, rng: Random) -> None:
    """Lines doubled, moved, indented otherwise, or joined."""
    lines = yaml.safe_dump(case.mapping, sort_keys=False).splitlines()
    for _ in range(rng.randint(1, 4)):
        i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
        how = rng.randrange(5)
        if how == 0:
            lines.insert(j, lines[i])
        elif how == 1:
            lines[i], lines[j] = lines[j], lines[i]
        elif how == 2:
            lines[i] = rng.choice((" ", "  ", "\t", "- ")) + lines[i]
        elif how == 3:
            lines[i] = lines[i].lstrip()
        else:
            lines[i] += rng.choice(
                (": x", " #", " &a", " *a", " |", " >", '"', "'", "{", "]", ",", " !!int", " !!python/name:os.system")
            )
    case.mapping = "\n".join(lines)


def text_yaml(case: Case, rng: Random) -> None:
    """YAML's own ways to surprise."""
    whole = yaml.safe_dump(case.mapping, sort_keys=False)
    bomb = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))
    keys = "? {}\n: 1\n".format(rng.choice(("[1, 2]", "{a: b}", "3.5", "null", "2001-01-01", "!!binary aGk=", "yes")))
    case.mapping = rng.choice(
        ("", "\n\n", "---\n---\n", "# nothing", "null", "42", "text", "[]", "- a\n- b", "{}", whole + "\n---\n" + whole,
         bomb + whole, whole + bomb, "a: &a [*a]\n" + whole, "&a {b: *a}", whole.replace("segments:",
         "segments: &s\n  <<: *s"),
         "<<: [1, 2]\n" + whole, "<<: {version: 2}\n" + whole, whole + keys, keys, "[" * 3000, "{" * 3000,
         "- " * 3000 + "a",
         "a: " * 500 + "b", "'" * 9999, whole.replace(": ", ":\t"), whole.replace("\n", "\r\n"), whole.replace("\n",
         "\r"),
         "%YAML 9.9\n---\n" + whole, "!!python/object/apply:os.system ['true']", "!!set {a, b}", "!!omap [a: 1]",
         "\ufeff" + whole, whole + "\0", whole + "\x07", whole + "\x85", "*unknown", "a: *unknown",
         whole + "x: 0o9\ny: 1_0e\n",
         whole + "d: 2001-99-99\n", whole + "d: 2001-02-30\n", whole + "b: !!binary '*'\n", whole + "i: !!int x\n",
         whole + "f: !!float ''\n", whole + "t: !!timestamp x\n", whole + "s: 190:20:30\n", whole + "n: 0x\n",
         whole.replace("version: 1", "version: 1_0:0"), whole + "i: 0b\n", whole + "i: +_\n", whole + "e: .\n",
         whole + "big: " + "9" * 6000 + "\n", whole.replace("noise: 0.01", "noise: " + "9" * 5000))
    )  # fmt: skip


MAPPINGS: dict[str, Kind] = {
    f"mapping: {f.__name__.replace('_', ' ')}": f
    for f in (
        missing,
        value,
        several,
        extra,
        renamed,
        exchanged,
        numbers,
        splits,
        names,
        text_bytes,
        text_lines,
        text_yaml,
    )
}
