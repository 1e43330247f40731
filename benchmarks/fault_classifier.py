"""A network that was shown simulated windows with faults: which faults it finds, and at which price.

    python benchmarks/fault_classifier.py --out DIR [--robots Jackal] [--lessons N] [--nominal N] [--held-out N]
                                          [--faulty N] [--effects N] [--encoder nn] [--epochs N] [--budget SECONDS]
                                          [--width W] [--seed S] [--jobs J] [--device cuda] [--compile] [--json FILE]
    python benchmarks/fault_classifier.py --quick

Machines and faults are those of `anomaly.py`: psi within `--width` of the prior's range about nominal; main mass, an
actuator's gain and friction at fixed sizes, and effects of the library drawn at run time. Each effect has a further
row at a size at which X / X_null of some windows is 5 or more, where it has the goal of the other faults. The network
learns from windows whose faults have sizes that are drawn (`simulate.faulty.lessons`). It never replays a window, so
that rates are counted on tens of thousands. Thresholds come from held-out nominal windows. Lessons are kept in DIR.
"""

import argparse
import os
import secrets
import sys
import tempfile
import time
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from anomalies.faults import Fault, faults
from anomalies.strength import strong
from numpy.typing import NDArray
from options import count, ended, json_file, number, write_json
from posteriors.fit import rounded
from timing import Table

from nfc_gym.core import InputError
from nfc_gym.inference.faults import FaultClassifier, FaultConfig
from nfc_gym.inference.progress import Spoken
from nfc_gym.inference.rates import auroc, rate_above, threshold_at
from nfc_gym.inference.train import TrainConfig
from nfc_gym.simulate.faulty import about_nominal, lessons
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.pool import unordered
from nfc_gym.simulate.trials import trials
from nfc_gym.simulate.watch import TRAINING, learn_faults

Array = NDArray[np.float64]
Windows = dict[str, NDArray]
RATES = (0.05, 0.01, 0.001)
GOAL = 0.995  # rate found at a false-positive rate of 0.001, of the faults that have a goal
_ROWS = 500  # windows that a process makes at once


class Course:
    """One robot: its belief, its faults, and windows of both.

    Args:
      robot: its name.
      args: of the command line.
      seed: of everything.
    """

    def __init__(self, robot: str, args: argparse.Namespace, seed: int) -> None:
        self.environment, self.seed, self.args = f"nfc_gym/{robot}Flat-v0", seed, args
        self.machine = Machine(self.environment)
        self.faults: list[Fault] = faults(self.machine, args.effects, np.random.default_rng([seed, 0]))
        self.faults += strong(self.machine, args.effects, np.random.default_rng([seed, 0]), args.width, seed)

    def psi(self, n: int, *stream: int) -> Array:
        """(n, d) about nominal."""
        return about_nominal(self.machine.space, self.args.width, n, np.random.default_rng([self.seed, *stream]))

    def lessons(self) -> Windows:
        """To learn from, kept in DIR."""
        args = self.args
        return lessons(
            self.environment, self.psi(args.lessons, 1), self.seed, jobs=args.jobs, folder=args.out, report=Spoken()
        )

    def judges(self) -> list[Windows]:
        """Noisy windows to judge by: held out, nominal, and of each fault, fewer where it throws the robot at once."""
        asked = [(self.args.held_out, None), (self.args.nominal, None), *((self.args.faulty, f) for f in self.faults)]
        tasks, found = [], [dict[int, Windows]() for _ in asked]
        for role, (n, fault) in enumerate(asked):
            psi = self.psi(n, 2, role) * (1 if fault is None else fault.scale)
            tasks += [(self.environment, psi[i : i + _ROWS], (self.seed, 3, role, i), fault)
                      for i in range(0, n, _ROWS)]  # fmt: skip
        made = (
            unordered(_windows, tasks, self.args.jobs) if self.args.jobs > 1 else enumerate(_windows(*t) for t in tasks)
        )
        for at, part in made:
            role, first = tasks[at][2][2:]
            found[role][first] = part
        return [{k: np.concatenate([f[i][k] for i in sorted(f)]) for k in ("states", "actions")} for f in found]


@lru_cache(maxsize=1)
def _machine(environment: str) -> Machine:
    return Machine(environment)


def _windows(environment: str, psi: Array, seed: tuple[int, ...], fault: Fault | None) -> Windows:
    """Of some rows; of a process of its own."""
    machine, given = _machine(environment), {}
    if fault is not None and fault.effect is not None and fault.theta is not None:
        fault.effect.bind(machine.model)
        given = {"effect": fault.effect, "theta": np.tile(fault.theta, (len(psi), 1))}
    return trials(machine, psi, int(np.random.default_rng(seed).integers(2**31)), **given)


def learned(course: Course, args: argparse.Namespace) -> FaultClassifier:
    """The network, trained; says how that went."""
    machine, device = course.machine, torch.device(args.device)
    config = TrainConfig(
        epochs=args.epochs, batch=args.batch, rate=args.rate, seed=course.seed, mixed=False, budget=args.budget,
        patience=args.epochs if args.budget else TRAINING.patience, compiled=args.compile,
    )  # fmt: skip
    folder = args.out / f"{machine.kind.name}_{args.encoder}_training"
    with rounded(device):
        net, out = learn_faults(
            machine, course.lessons(), config, FaultConfig(encoder=args.encoder), folder=folder, device=device,
            report=Spoken(),
        )  # fmt: skip
    print(
        f"{machine.kind.name}: {out.stopped} after {len(out.train)} epochs, {out.seconds:.0f} s, best {out.best}, "
        f"held-out loss {out.start:.4f} -> {min(out.held_out):.4f}, train {out.train[-1]:.4f}", flush=True,
    )  # fmt: skip
    return net


def measure(table: Table, course: Course, args: argparse.Namespace) -> None:
    """All rows of one robot."""
    robot, began, seeds = course.machine.kind.name, time.monotonic(), (course.seed,)
    net = learned(course, args)

    held, nominal, *faulty = (net.score(w["states"], w["actions"]) for w in course.judges())
    limits = {}
    for rate in RATES:
        try:
            limits[rate] = threshold_at(held, rate).value
        except InputError as e:
            print(f"{robot}: {e}", flush=True)
            continue
        found, error = rate_above(nominal, limits[rate])
        table.add(
            f"{robot}: false-positive rate on other windows, wanted {rate:g} (+- {error:.2g})", found, "1", seeds=seeds
        )
    for fault, scores in zip(course.faults, faulty, strict=True):
        if len(scores) < args.faulty / 2:
            print(f"{robot}, {fault.name}: throws the robot at once; left out", flush=True)
        else:
            _report(table, f"{robot}, {fault.name}", fault.wanted, nominal, scores, limits, seeds)
    print(f"{robot}: {time.monotonic() - began:.0f} s", flush=True)


def _report(
    table: Table, name: str, wanted: bool, nominal: Array, faulty: Array, limits: dict[float, float],
    seeds: tuple[int, ...],
) -> None:  # fmt: skip
    """Rows of one fault at one size."""
    area, error = auroc(nominal, faulty)
    table.add(f"{name}: AUROC (+- {error:.2g})", area, "1", seeds=seeds)
    for rate, limit in limits.items():
        found, error = rate_above(faulty, limit)
        goal = GOAL if wanted and rate == min(RATES) else None
        table.add(f"{name}: TPR at FPR {rate:g} (+- {error:.2g})", found, "1", at_least=goal, seeds=seeds)


def main() -> None:
    """Command line."""
    args = _arguments()
    torch.set_num_threads(1)
    table = Table()
    seed = secrets.randbits(31) if args.seed is None else args.seed
    print(f"seed {seed}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        args.out = args.out or Path(folder)
        for robot in args.robots:
            measure(table, Course(robot, args, seed), args)
    if args.json:
        write_json(args.json, [asdict(r) for r in table.rows])


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add: Any = parser.add_argument
    add("--robots", nargs="+", type=str.capitalize, default=["Jackal"],
        choices=("Jackal", "Ant", "Quadruped", "Humanoid", "Quadcopter"), help="default Jackal")  # fmt: skip
    add("--out", type=Path, metavar="DIR", help="keeps lessons and the state of training")
    add("--lessons", type=count(2), default=100_000, help="windows to learn from, half of them with a fault")
    add("--nominal", type=count(1), default=10_000, help="windows that false alarms are counted on")
    add("--held-out", type=count(1), default=10_000, help="nominal windows that thresholds are taken from")
    add("--faulty", type=count(1), default=1000, help="windows of each fault and size")
    add("--effects", type=count(0), default=6, help="effects of the library, drawn")
    add("--encoder", choices=("tcn", "nn"), default="tcn", help="of the motion (default %(default)s)")
    add("--epochs", type=count(1), default=60, help="passes over the lessons, at most")
    add("--budget", type=number(0), default=0, metavar="SECONDS", help="of training; 0 for any number")
    add("--batch", type=count(1), default=1024, help="windows a step")
    add("--rate", type=number(0), default=1e-3, help="largest step size")
    add("--width", type=number(0, 1), default=0.02, help="of psi about nominal, in the prior's range")
    add("--seed", type=count(0), help="default drawn, and printed; a run goes on with the seed that it was begun with")
    add("--jobs", type=count(1), default=1, help="processes that simulate")
    add("--device", default="cpu", help="that the network learns on: cpu or cuda")
    add("--compile", action="store_true", help="compile training steps first")
    add("--quick", action="store_true", help="a few windows: says little")
    add("--json", type=json_file, metavar="FILE",
        help="write the rows here: a list of {name, value, unit, baseline, goal, holds, seeds}")  # fmt: skip
    args = parser.parse_args()
    if args.quick:
        args.lessons, args.nominal, args.held_out, args.faulty, args.effects = 64, 100, 100, 10, 1
        args.epochs, args.batch = 1, 32
    return args


if __name__ == "__main__":
    sys.exit(ended(main))
