"""All cells of posterior_table.py on a machine with several GPUs: processors simulate, GPUs train, both all the time.

    python benchmarks/posterior_queue.py --out DIR [--gpus 0 1] [--per-gpu 3] [--jobs 9] [--budget 60] [--stop 1200]
        [--windows JackalFlat=100000 AntFlat=100000 ...] [--residuals JackalFlat ...] [--json FILE] [--quick]

Environments come in the order of WINDOWS, or of `--windows`. One after the other is simulated by `--jobs` processes;
as soon as one's windows are there, its cells are trained, ours first, by `--per-gpu` processes on each GPU, each of
which is one posterior_table.py of some methods. Ceilings are computed between, residual heads and pictures at the end.
Everything is kept as it is done: the same command goes on where it was killed, and DIR/table.md is always up to date.
What the processes say is in DIR/logs. `--gpus cpu` trains on the processor.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from options import count, ended, json_file, number, write_json
from posteriors.keep import results
from posteriors.methods import INPUTS, METHODS, cell_name
from posteriors.paper import ROBOTS, TERRAINS
from posteriors.sets import HALF, JUDGE, TRAIN, environment, stored

from nfc_gym.core.errors import InputError, NfcError

TABLE = Path(__file__).with_name("posterior_table.py")
# Windows to train on: fewer where a window of motion takes long to simulate.
WINDOWS = {
    "JackalFlat": 200_000, "AntFlat": 100_000, "JackalRough": 60_000, "AntRough": 60_000, "QuadcopterFlat": 100_000,
    "QuadrupedFlat": 60_000, "HumanoidFlat": 60_000, "QuadcopterRough": 60_000, "QuadrupedRough": 40_000,
    "HumanoidRough": 40_000,
}  # fmt: skip
WINDOWS_SAID = " ".join(f"{k}={v}" for k, v in WINDOWS.items())
# Methods that one process trains after the other, since a process takes its time to start; and the stage that they
# belong to: all environments have their first before any has its second. Further inputs come after all of that, and
# sbi's peers, which have to be asked for, see the first inputs alone.
GROUPS = (
    (("sde-tcn", "mdn-tcn"), 0), (("sde-nn", "sde-rff"), 0), (("mdn-rff", "sde-fks"), 0), (("flow-tcn",), 1),
    (("sbi-npe",), 1), (("sbi-npse",), 1),
)  # fmt: skip
RESIDUALS = 1  # the stage of the residual heads
# What every process is told as it was told here.
PASSED = (
    "out", "judges", "samples", "budget", "batch", "rate", "draws", "epochs", "effects", "residual-windows", "few",
    "ceiling-windows", "jobs", "peer-judges",
)  # fmt: skip
_CEILINGS_AFTER = 2  # environments that are simulated before the first ceiling is computed


@dataclass(order=True)
class Job:
    """What one process does on a GPU: flags of posterior_table.py for one environment.

    The least `rank` comes first: stage, environment, group.
    """

    rank: tuple[int, int, int]
    place: str = field(compare=False)
    name: str = field(compare=False)
    flags: list[str] = field(compare=False)


class Queue:
    """Jobs that may begin, and whether more will come."""

    def __init__(self) -> None:
        self._jobs: list[Job] = []
        self._changed = threading.Condition()
        self._closed = False

    def add(self, *jobs: Job) -> None:
        """These may begin."""
        with self._changed:
            self._jobs = sorted([*self._jobs, *jobs])
            self._changed.notify_all()

    def close(self) -> None:
        """No more will come."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def next(self) -> Job | None:
        """The first; waits where there is none yet, and gives None where none will come."""
        with self._changed:
            self._changed.wait_for(lambda: self._jobs or self._closed)
            return self._jobs.pop(0) if self._jobs else None


def split(place: str) -> tuple[str, str]:
    """Robot and ground of an environment's name.

    Raises:
      InputError: there is none of that name.
    """
    known = {r + t: (r, t) for r in ROBOTS for t in TERRAINS}
    if place not in known:
        raise InputError(f"no environment {place!r}; there are: {', '.join(known)}")
    return known[place]


def run(args: argparse.Namespace, place: str, name: str, flags: list[str], gpu: str | None) -> None:
    """One posterior_table.py; what it says goes into DIR/logs."""
    robot, terrain = split(place)
    began = time.monotonic()
    left = args.ends - began
    if left <= 0:
        return
    device = "cpu" if gpu in (None, "cpu") else "cuda"
    command = [
        sys.executable, str(TABLE), "--robots", robot, "--terrain", terrain, "--windows",
        str(args.windows.get(place, args.residual_windows)), "--device", device, "--stop", f"{left:.0f}", *flags,
        "--seeds", *map(str, args.seeds), *(["--small"] if args.small else []), *(["--mirror"] if args.mirror else []),
        *(["--adamw"] if args.adamw else []), *(["--compile"] if args.compile else []),
    ]  # fmt: skip
    command += [part for name in PASSED for part in (f"--{name}", str(getattr(args, name.replace("-", "_"))))]
    env = os.environ | ({} if gpu in (None, "cpu") else {"CUDA_VISIBLE_DEVICES": gpu})
    with (args.out / "logs" / f"{place}_{name}.log").open("a") as log:
        code = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, env=env, check=False).returncode
    if code:
        args.failed.append(f"{place} {name}")
    print(f"{time.monotonic() - args.began:6.0f} s  {place} {name}: {time.monotonic() - began:.0f} s"
          + (f", FAILED with {code}: see logs" if code else ""), flush=True)  # fmt: skip


def worker(args: argparse.Namespace, queue: Queue, gpu: str) -> None:
    """Jobs one after the other on one GPU."""
    while (job := queue.next()) is not None:
        run(args, job.place, job.name, job.flags, gpu)


def simulated(args: argparse.Namespace, place: str, windows: int, effects: float, maps: bool = False) -> bool:
    """The sets of one environment; False, and said why, where they cannot be made: the others go on."""
    began = time.monotonic()
    env, said = environment(*split(place)), f"{windows} windows simulated"
    try:
        for seed, wanted in ((JUDGE, args.judges), (TRAIN, windows)):
            stored(args.out, env, wanted, seed, args.jobs, maps, effects)
    except NfcError as e:
        said = f"FAILED: {e}"
        args.failed.append(place)
    now = time.monotonic()
    print(f"{now - args.began:6.0f} s  {place}: {said} in {now - began:.0f} s", flush=True)
    return not said.startswith("FAILED")


def processors(args: argparse.Namespace, queue: Queue) -> None:
    """What the processors do, in order; it lets GPUs begin as windows are there."""
    left: list[str] = []  # have windows, and no ceiling yet
    try:
        for i, place in enumerate(args.windows):
            if time.monotonic() > args.ends:
                return
            if simulated(args, place, args.windows[place], args.effects):
                queue.add(*cells(args, i, place))
                left.append(place)
            if i + 1 >= _CEILINGS_AFTER and left:
                ceiling(args, left.pop(0))
        for place in left:
            ceiling(args, place)
        for i, place in enumerate(args.residuals):
            if time.monotonic() < args.ends and simulated(args, place, args.residual_windows, HALF, maps=True):
                flags = ["--methods", "--extras", "residuals", "plots"]
                queue.add(Job((RESIDUALS, i, len(GROUPS)), place, "residuals", flags))
    finally:
        queue.close()


def ceiling(args: argparse.Namespace, place: str) -> None:
    """That of one environment, on the processors."""
    few = ["--ceiling-draws", "16", "4"] if args.quick else []
    run(args, place, "ceiling", ["--methods", "--extras", "ceiling", *few], None)


def cells(args: argparse.Namespace, i: int, place: str) -> list[Job]:
    """What is trained on the i-th environment; pictures are drawn anew when another group of methods is done."""
    jobs = []
    for k, inputs in enumerate(args.inputs):
        for g, (group, stage) in enumerate(GROUPS):
            methods = [m for m in group if m in args.methods and not (k and METHODS[m].peer)]
            methods = [m for m in methods if not all(kept(args, place, m, inputs, seed) for seed in args.seeds)]
            more = ["axle"] if place == "JackalFlat" and "sde-tcn" in methods else []
            flags = ["--inputs", inputs, "--methods", *methods, "--extras", *more, "plots"]
            if methods:
                jobs.append(Job((2 * k + stage, i, g), place, f"{methods[0]}_{inputs}", flags))
    return jobs


def kept(args: argparse.Namespace, place: str, method: str, inputs: str, seed: int) -> bool:
    """Whether that cell is there already; one whose library was missing is tried again."""
    file = args.out / "cells" / f"{cell_name(place, method, inputs, seed)}.json"
    return file.is_file() and "missing" not in json.loads(file.read_text())


def main() -> int:
    """Command line."""
    args = _arguments()
    with tempfile.TemporaryDirectory() as folder:
        scratch, args.out = args.out is None, args.out or Path(folder)
        code = fill(args)
        if args.json:
            write_json(args.json, results(args.out))
        if scratch and (args.out / "table.md").is_file():  # which goes with its folder
            print((args.out / "table.md").read_text())
        return code


def fill(args: argparse.Namespace) -> int:
    """Threads that train and this one, which simulates, until all is done; 1 where something failed."""
    args.began, args.failed = time.monotonic(), []
    args.ends = args.began + args.stop if args.stop else float("inf")
    (args.out / "logs").mkdir(parents=True, exist_ok=True)
    queue = Queue()
    workers = [threading.Thread(target=worker, args=(args, queue, g)) for _ in range(args.per_gpu) for g in args.gpus]
    for thread in workers:
        thread.start()
    processors(args, queue)
    for thread in workers:
        thread.join()
    table = args.out / "table.md"
    said = f"FAILED: {', '.join(args.failed)}; " if args.failed else "done: "
    print(f"{time.monotonic() - args.began:6.0f} s  {said}{table if table.is_file() else 'no table yet'}")
    return 1 if args.failed else 0


def _counts(pairs: list[str]) -> dict[str, int]:
    try:
        return {place: count(1)(text) for place, text in (p.split("=") for p in pairs)}
    except ValueError:
        raise InputError(f"--windows {' '.join(pairs)}: want NAME=COUNT, as JackalFlat=100000") from None
    except argparse.ArgumentTypeError as error:
        raise InputError(f"--windows {' '.join(pairs)}: {error}") from None


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder for everything")
    parser.add_argument("--quick", action="store_true", help="a toy: one cell of the Jackal's, on the processor")
    parser.add_argument(
        "--windows", nargs="+", default=WINDOWS_SAID.split(), metavar="NAME=COUNT",
        help=f"environments, in order, and how many windows to train on; default {WINDOWS_SAID}",
    )  # fmt: skip
    parser.add_argument(
        "--residuals", nargs="*", default=[], metavar="NAME", help="environments with residual heads; default none"
    )
    parser.add_argument(
        "--residual-windows", type=count(0), default=20_480,
        help="windows that the residual heads learn from (default %(default)s)",
    )  # fmt: skip
    methods = [m for group, _ in GROUPS for m in group]
    add = parser.add_argument
    add("--methods", nargs="+", choices=methods, default=[m for m in methods if not METHODS[m].peer],
        help="density and encoder of each column; sbi-... are the package sbi's; default all but sbi's")  # fmt: skip
    add("--inputs", nargs="+", choices=list(INPUTS), default=["summaries", "window"],
        help="what networks see: the window of motion, beside it physics summaries, with these a linear start, or the "
             "map; default summaries window")  # fmt: skip
    add("--seeds", nargs="+", type=count(0), default=[0], help="of networks and training, a cell each; default 0")
    add("--effects", type=number(0, 1), default=0.0,
        help="share of the windows with an effect not in the model, 0 to 1 (default %(default)s)")  # fmt: skip
    add("--gpus", nargs="+", default=["0"], help="their numbers, or cpu; default 0")
    add("--per-gpu", type=count(1), default=3,
        help="processes that train on one GPU at the same time (default %(default)s)")  # fmt: skip
    add("--jobs", type=count(0), default=0, help="processes that simulate; default 0 takes all cores")
    add("--stop", type=number(0), default=0, metavar="SECONDS",
        help="begin nothing new after these; default 0 sets no end")  # fmt: skip
    add("--judges", type=count(1), default=2000,
        help="windows not trained on, by which all are judged (default %(default)s)")  # fmt: skip
    add("--peer-judges", type=count(1), default=200,
        help="of those, for NPSE, whose densities take long (default %(default)s)")  # fmt: skip
    add("--samples", type=count(1), default=256,
        help="draws of psi a window, by which it is judged (default %(default)s)")  # fmt: skip
    add("--budget", type=number(0), default=60, metavar="SECONDS", help="of training a cell (default %(default)s)")
    add("--epochs", type=count(1), default=200, help="passes over the windows at most (default %(default)s)")
    add("--batch", type=count(1), default=1024, help="windows a training step (default %(default)s)")
    add("--rate", type=number(0), default=1e-3, help="largest step size (default %(default)s)")
    add("--draws", type=count(1), default=8,
        help="of noise a window and training step, of score models (default %(default)s)")  # fmt: skip
    add("--json", type=json_file, metavar="FILE", help="write all results of DIR here: {name: {figure: value}}")
    add("--few", type=count(1), default=50,
        help="windows that are replayed, or whose maps are drawn (default %(default)s)")  # fmt: skip
    add("--ceiling-windows", type=count(1), default=8, help="that a ceiling is the mean of (default %(default)s)")
    parser.add_argument("--small", action="store_true", help="networks of a toy's size")
    parser.add_argument("--mirror", action="store_true", help="show half of each step's windows in each mirror")
    parser.add_argument("--adamw", action="store_true", help="change matrices by AdamW too, in place of Muon")
    parser.add_argument("--compile", action="store_true", help="compile training steps first")
    args = parser.parse_args()
    if args.quick:
        args.windows, args.methods, args.inputs, args.gpus = ["JackalFlat=128"], ["mdn-rff"], ["summaries"], ["cpu"]
        args.per_gpu, args.jobs, args.judges, args.samples, args.small = 1, 1, 32, 32, True
        args.epochs, args.budget, args.ceiling_windows, args.batch, args.residuals = 1, 1.0, 1, 64, []
    elif args.out is None:
        parser.error("name a folder: --out DIR")
    args.windows = _counts(args.windows)
    for place in [*args.windows, *args.residuals]:
        split(place)
    return args


if __name__ == "__main__":
    sys.exit(ended(main))
