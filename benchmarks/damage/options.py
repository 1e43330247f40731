"""Command lines that nobody should type."""

from collections.abc import Callable
from pathlib import Path
from random import Random

_NUMBERS = (
    "-1",
    "0",
    "1",
    "1.5",
    "nan",
    "inf",
    "1e-300",
    "1e300",
    "-inf",
    "",
    "x",
    "99999999999999999999",
    "4294967295",
    "٣",
    "0x10",
    " 1",
)


def outs(folder: Path, rng: Random) -> str:
    """Places to write to that are none, or that are somebody's."""
    (folder / "file").write_text("mine")
    (folder / "full").mkdir(exist_ok=True)
    (folder / "full" / "photo").write_text("mine")
    return str(rng.choice((folder / "file", folder / "file" / "below", folder / "full", Path("/proc/nothing/here"),
    Path("/dev/full"),
                           Path("/sys/none"), Path("/dev/null"), folder / ("x" * 300), folder / "mapping.yaml",
                           Path("/proc/self/mem"))))  # fmt: skip


def close_loop(folder: Path, rng: Random) -> list[str]:
    good = rng.random() < 0.5
    line = ["close-loop", str(folder / "mapping.yaml"), "--out", str(folder / "out") if good else outs(folder, rng)]
    if not good:
        return line
    return line + rng.choice((
        ["--seed", rng.choice(_NUMBERS[:1] + _NUMBERS[3:])], ["--jobs", rng.choice(("-1", "1.5", "x", "1000000",
        "99999999999999999999"))],
        ["--fold", rng.choice(("", "run_0", "nobody", "ü", "../x"))], ["--sed", "1"], ["--out"], ["more"],
        ["--resume=3"],
    ))  # fmt: skip


def predict(folder: Path, rng: Random) -> list[str]:
    good = rng.random() < 0.7
    line = [
        "predict",
        str(folder / "mapping.yaml"),
        "--out",
        str(folder / "p.npz") if good else outs(folder, rng),
        "--stage",
        "nominal",
    ]
    return line + rng.choice((
        ["--restart", rng.choice(_NUMBERS)], ["--mode", rng.choice(("inverse", "forward", "rollout", "x", ""))],
        ["--fit", str(folder / "no")],
        ["--fit", str(folder / "mapping.yaml"), "--stage", "extended"], ["--stage", rng.choice(("", "calibrated",
        "NOMINAL"))], ["--restart"],
    ))  # fmt: skip


def check(folder: Path, rng: Random) -> list[str]:
    return ["check", rng.choice((str(folder), str(folder / "no.yaml"), str(folder / "machine.xml"),
    str(folder / "run_0.npz"), "", "/dev/null", "/dev/zero",
                                 "/proc/self/mem", "\udcff", str(folder / ("x" * 300)),
                                 str(folder / "mapping.yaml" / "x")))]  # fmt: skip


def demo(folder: Path, rng: Random) -> list[str]:
    return ["demo", "--out", outs(folder, rng), *rng.choice(([], ["--seed", "-1"], ["--seed", "x"], ["--overwrite"]))]


def nonsense(folder: Path, rng: Random) -> list[str]:
    words = (  # without `demo`, which any folder to write to makes a whole loop of
        "check",
        "close-loop",
        "predict",
        "--out",
        "--help=1",
        "--version=2",
        "--seed",
        "-x",
        "--",
        "",
        "ü",
        "--fit",
        str(folder),
    )
    return [rng.choice(words) for _ in range(rng.randint(1, 5))]


OPTIONS: dict[str, Callable[[Path, Random], list[str]]] = {
    f"command line: {f.__name__}": f for f in (close_loop, predict, check, demo, nonsense)
}
