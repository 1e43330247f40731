"""All tests by folder, all benchmarks in their short form and the linters: two at a time, the longest first.

    python .ci/pieces.py [NAME ...]

A name is a folder of tests (`tests/core`), `tests` for what lies in none, a benchmark (`benchmarks/anomaly`), `check`.
Each piece of Python runs in a fork of this process, which has the large libraries loaded: to load torch and torchrl
takes longer than most of the pieces do. The linters, which want none, begin before. A piece's output is shown when it
is over, with its seconds and those of the processor, which other work on the machine changes less. Exits with 1 where
one fails, after all have run.
"""

import atexit
import gc
import importlib
import os
import runpy
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

HEAVY = (
    "gymnasium", "mujoco.batch", "pandas", "plotly", "scipy.optimize", "scipy.stats", "stable_baselines3", "torch",
    "torchrl.collectors", "torchrl.envs", "torchrl.objectives", "torchrl.record",
)  # fmt: skip
ROOT = Path(__file__).parents[1]
AT_ONCE = 2
# Those that take longest, in order: begun last, they would be waited for.
LONGEST = (
    "tests/measured", "tests/adaptation", "tests/inference", "tests/simulate", "tests/benchmarks",
    "tests/conformance", "tests/wrappers", "tests/physics", "benchmarks/foreign_machines", "tests/envs",
)  # fmt: skip

Piece = Callable[[], int | str | None]  # what `sys.exit` takes


@dataclass
class Running:
    """A piece under way: its name, when it began, and what it has said."""

    name: str
    began: float
    said: IO[bytes]


def tests(*where: str) -> int:
    """pytest, with the slowest of its tests."""
    import pytest

    return pytest.main([*where, "--durations", "12"])


def benchmark(path: Path) -> None:
    """A script, as `python path --quick` runs it."""
    sys.argv, sys.path[0] = [str(path), "--quick"], str(path.parent)
    runpy.run_path(str(path), run_name="__main__")


def check() -> int:
    """Linters and types."""
    return subprocess.run(["make", "check"], check=False).returncode


def pieces() -> dict[str, Piece]:
    """All by name, in the order in which they begin; a folder or benchmark that is new is found."""
    folders = sorted({p.parent for p in ROOT.glob("tests/*/test_*.py")})
    scripts = sorted(ROOT.glob("benchmarks/*.py"))
    found: dict[str, Piece] = {"check": check}
    found |= {f"tests/{folder.name}": partial(tests, f"tests/{folder.name}") for folder in folders}
    found["tests"] = partial(tests, *(f"tests/{path.name}" for path in sorted(ROOT.glob("tests/test_*.py"))))
    found |= {f"benchmarks/{path.stem}": partial(benchmark, path) for path in scripts}
    return {name: found[name] for name in dict.fromkeys([*LONGEST, *found])}


def begin(piece: Piece, said: IO[bytes]) -> int:
    """The number of a forked process that runs a piece and says all into a file."""
    child = os.fork()
    if child:
        return child
    code: int | str | None = 1
    try:
        for stream in (1, 2):
            os.dup2(said.fileno(), stream)
        code = piece()
    except SystemExit as left:
        code = left.code
    except BaseException:
        traceback.print_exc()
    finally:
        if isinstance(code, str):
            print(code, file=sys.stderr)
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        # Not `sys.exit`, which takes every module of the libraries down one by one: seconds of a processor.
        os._exit(code if isinstance(code, int) else int(code is not None))


def start(name: str, piece: Piece, running: dict[int, Running]) -> None:
    """Begin a piece, and note it among those under way."""
    said = tempfile.TemporaryFile()  # noqa: SIM115 (`end` closes it)
    running[begin(piece, said)] = Running(name, time.monotonic(), said)


def end(running: dict[int, Running]) -> str | None:
    """Wait until one is over, show it, and give its name if it failed."""
    child, status, used = os.wait4(-1, 0)
    piece, code = running.pop(child), os.waitstatus_to_exitcode(status)
    with piece.said as said:
        said.seek(0)
        shutil.copyfileobj(said, sys.stdout.buffer)
    seconds, busy = time.monotonic() - piece.began, used.ru_utime + used.ru_stime
    print(f"== {piece.name}: {seconds:.0f} s, {busy:.0f} s of a processor, exit code {code}", flush=True)
    return piece.name if code else None


def main() -> None:
    """Command line."""
    found, began = pieces(), time.monotonic()
    if unknown := [name for name in sys.argv[1:] if name not in found]:
        sys.exit(f"no piece {', '.join(unknown)}; there are: {', '.join(found)}")
    os.chdir(ROOT)
    running: dict[int, Running] = {}
    failed: list[str | None] = []
    wanted = list(dict.fromkeys(sys.argv[1:] or found))
    if "check" in wanted:  # wants no library: it begins while they load
        wanted.remove("check")
        start("check", found["check"], running)
    for name in HEAVY:
        importlib.import_module(name)
    gc.freeze()  # the libraries' objects stay: no piece need look through them again at each collection
    print(f"== libraries: {time.monotonic() - began:.0f} s", flush=True)
    for name in wanted:
        if len(running) == AT_ONCE:
            failed.append(end(running))
        start(name, found[name], running)
    while running:
        failed.append(end(running))
    print(f"== all: {time.monotonic() - began:.0f} s")
    sys.exit(f"failed: {', '.join(filter(None, failed))}" if any(failed) else 0)


if __name__ == "__main__":
    main()
