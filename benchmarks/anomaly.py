"""Anomaly detectors on simulated windows with and without faults: what is found, and at which price.

    python benchmarks/anomaly.py --out DIR [--robots Jackal Ant ...] [--nominal N] [--held-out N] [--faulty N]
                                 [--training N] [--epochs N] [--effects N] [--draws N] [--levels N] [--lessons N]
                                 [--width W] [--seed S] [--jobs J] [--stop SECONDS] [--json FILE]
    python benchmarks/anomaly.py --quick

Every machine's psi is drawn within `--width` of the prior's range about nominal, and the replay believes that
distribution and no more. Faults: main mass, an actuator's gain, friction, and effects of the library drawn at run
time, each at several sizes; X / X_null says how far a size drives the replay's mean X. Thresholds come from held-out
nominal windows; rates that those cannot show are named and left out. Windows count one by one, nothing is adjusted
for neighbours. The baseline is an unconditional test: the distance of a window's means and deviations, of states and
their steps, from those of nominal training windows, at the same false-positive rate.

Finished parts of 50 windows are kept in DIR, so that the same command goes on where it was stopped.
"""

import argparse
import json
import os
import secrets
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from anomalies.course import Course, Part, Settings, parts, replayed
from anomalies.strength import STRONG
from anomalies.unconditional import Unconditional
from numpy.typing import NDArray
from options import count, ended, json_file, number, write_json
from posteriors.keep import Kept
from timing import Table

from nfc_gym.core import InputError
from nfc_gym.inference.contrast import Contrast
from nfc_gym.inference.data import TensorWindows
from nfc_gym.inference.rates import auroc, rate_above, threshold_at
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import TrainConfig, train
from nfc_gym.simulate.judge import Judge
from nfc_gym.simulate.pool import unordered

Array = NDArray[np.float64]
Scores = dict[str, Array]
RATES = (0.05, 0.01, 0.001)
LEVEL = 0.01  # share of nominal windows in which each fault of the bank alone would be believed
GOAL = 0.995  # rate found at a false-positive rate of 0.001
DETECTORS = ("replay", "bank", "judge", "contrast", "unconditional")


class Bench:
    """One robot: every detector's scores of its windows.

    Args:
      settings: of its course.
      args: of the command line.
      kept: where finished parts lie.
    """

    def __init__(self, settings: Settings, args: argparse.Namespace, kept: Kept) -> None:
        self.settings, self.args, self.kept = settings, args, kept
        self.course = Course(settings)
        self.asked = {
            "levels": parts("levels", args.levels),
            "lessons": parts("lessons", args.lessons),
            "held out": parts("held out", args.held_out),
            "nominal": parts("nominal", args.nominal),
        } | {i: parts("faulty", args.faulty, i) for i in range(len(self.course.faults))}

    def run(self, ends: float) -> dict[str | int, Scores] | None:
        """Scores by role, or by number of a fault; None where time ran out before all were there."""
        wanted = [p for group in self.asked.values() for p in group]
        missing = [p for p in wanted if not self.kept.has(self._name(p))]
        robot, began = self.settings.robot, time.monotonic()
        print(f"{robot}: {len(missing)} of {len(wanted)} parts to replay", flush=True)

        def tasks() -> Iterator[tuple[Settings, Part]]:
            for part in missing:
                if time.monotonic() > ends:
                    return
                yield self.settings, part

        with ThreadPoolExecutor(1) as beside:
            learned = beside.submit(self._learned, wanted, ends)
            done = 0
            for number, found in unordered(replayed, tasks(), self.args.jobs):
                self.kept.keep(self._name(missing[number]), found)
                done += 1
                if done % max(1, len(missing) // 10) == 0:
                    print(f"{robot}: {done} parts, {time.monotonic() - began:.0f} s", flush=True)
            if done < len(missing):
                print(f"{robot}: time is up, {len(missing) - done} parts are left: the same command goes on")
                return None
            others = learned.result()
        return self._gathered(others) if others else None

    def _name(self, part: Part) -> str:
        return f"{self.settings.robot}_{part.name}"

    def _learned(self, wanted: list[Part], ends: float) -> dict[Part, Scores] | None:
        """Scores of the detectors that are trained on nominal windows; None where time is up."""
        course, args, seed = self.course, self.args, self.settings.seed
        windows = [course.windows(p) for p in parts("training", args.training)]
        training = {k: np.concatenate([w[k] for w in windows]) for k in ("states", "actions", "psi")}
        plain, space = Unconditional(training), course.machine.space
        tensors = {k: torch.as_tensor(training[k], dtype=torch.float32) for k in ("states", "actions")}
        tensors["psi"] = torch.as_tensor((training["psi"] - space.low) / (space.high - space.low), dtype=torch.float32)
        contrast = Contrast.of(tensors, PriorBox.of(space, course.machine.kind.name), seed=seed)
        config = TrainConfig(epochs=args.epochs, batch=64, warmup=20, seed=seed)
        folder = self.kept.folder(f"{self.settings.robot}_contrast")
        outcome = train(contrast, *TensorWindows(tensors).split(0.1), config, folder=folder, device=args.device)
        loss = f"held-out loss {outcome.start:.3f} -> {min(outcome.held_out):.3f}"
        print(f"{self.settings.robot}: contrast net: {outcome.stopped} after {len(outcome.train)} epochs, "
              f"best {outcome.best}, {loss}", flush=True)  # fmt: skip
        found = {}
        for part in wanted:
            if time.monotonic() > ends:
                return None
            windows = course.windows(part)
            scores = contrast.score(windows["states"], windows["actions"])
            found[part] = {"contrast": scores, "unconditional": plain.score(windows)}
        return found

    def _gathered(self, others: dict[Part, Scores]) -> dict[str | int, Scores]:
        out: dict[str | int, Scores] = {}
        for role, group in self.asked.items():
            each = [self.kept.get(self._name(p)) | others[p] for p in group]
            for part in each:  # a list of no windows has forgotten how many faults there are
                part["gains"] = np.reshape(part["gains"], (-1, len(self.course.bank.names)))
            out[role] = {k: np.concatenate([np.asarray(e[k]) for e in each]) for k in each[0]}
        offset = np.quantile(out["levels"]["gains"], 1 - LEVEL, axis=0)
        for scores in out.values():
            scores["bank"] = (scores["gains"] - offset).max(1)
            unexplained = self.course.bank.unexplained(np.stack([scores["replay"], scores["x"]], 1))
            scores["evidence"] = np.concatenate([scores["gains"], unexplained], 1)
        judge = Judge.learned(out["levels"]["evidence"], out["lessons"]["evidence"])
        for scores in out.values():
            scores["judge"] = judge.odds(scores["evidence"])
        unit = {k: np.quantile(out["held out"][k], 0.95) for k in ("replay", "contrast")}
        for scores in out.values():
            scores["either"] = np.maximum(*(scores[k] / unit[k] for k in unit))
        return out


def measure(table: Table, bench: Bench, scores: dict[str | int, Scores]) -> None:
    """All rows of one robot."""
    robot, seeds = bench.settings.robot, (bench.settings.seed,)
    held, nominal = scores["held out"], scores["nominal"]
    limits: dict[float, dict[str, float]] = {}
    for rate in RATES:
        try:
            limits[rate] = {k: threshold_at(held[k], rate).value for k in (*DETECTORS, "either")}
        except InputError as e:
            print(f"{robot}: {e}", flush=True)
            continue
        for k in limits[rate]:
            found, error = rate_above(nominal[k], limits[rate][k])
            what = f"{robot}, {k}: false-positive rate on other windows, wanted {rate:g} (+- {error:.2g})"
            table.add(what, found, "1", seeds=seeds)
    null = float(np.median(nominal["x"]))
    table.add(f"{robot}: median X of nominal windows", null, "1", seeds=seeds)
    for i, fault in enumerate(bench.course.faults):
        faulty = scores[i]
        if len(faulty["x"]) < bench.args.faulty / 2:
            print(f"{robot}, {fault.name}: throws the robot at once ({len(faulty['x'])} windows left); left out")
            continue
        strength = float(np.median(faulty["x"])) / null
        wanted = fault.wanted or (fault.effect is not None and strength >= STRONG)
        report(table, f"{robot}, {fault.name}, X/X_null {strength:.2f}", wanted, nominal, faulty, limits, seeds)


def report(
    table: Table, name: str, wanted: bool, nominal: Scores, faulty: Scores, limits: dict[float, dict[str, float]],
    seeds: tuple[int, ...],
) -> None:  # fmt: skip
    """Rows of one fault at one size."""
    base = auroc(nominal["unconditional"], faulty["unconditional"])[0]
    for k in ("replay", "bank", "judge", "contrast", "either"):
        area, error = auroc(nominal[k], faulty[k])
        table.add(f"{name}: AUROC, {k} (+- {error:.2g})", area, "1", baseline=base, seeds=seeds)
        for rate, limit in limits.items():
            found, error = rate_above(faulty[k], limit[k])
            other = rate_above(faulty["unconditional"], limit["unconditional"])[0]
            goal = GOAL if wanted and rate == min(RATES) and k != "contrast" else None
            table.add(f"{name}: TPR at FPR {rate:g}, {k} (+- {error:.2g})", found, "1", baseline=other, at_least=goal,
                      seeds=seeds)  # fmt: skip


def main() -> None:
    """Command line."""
    args = _arguments()
    torch.set_num_threads(1)
    ends = time.monotonic() + args.stop if args.stop else float("inf")
    table = Table()
    with tempfile.TemporaryDirectory() as folder:
        kept, seed = opened(args.out or Path(folder), args)
        print(f"seed {seed}", flush=True)
        for robot in args.robots:
            bench = Bench(Settings(robot, seed, args.width, args.draws, args.effects, args.quick), args, kept)
            if scores := bench.run(ends):
                measure(table, bench, scores)
    if args.json:
        write_json(args.json, [asdict(r) for r in table.rows])


def opened(out: Path, args: argparse.Namespace) -> tuple[Kept, int]:
    """What is kept, and the seed: the given one, else that of the folder, else a new one."""
    before = out / "settings.json"
    kept = json.loads(before.read_text())["seed"] if before.is_file() else None
    seed = args.seed if args.seed is not None else kept if kept is not None else secrets.randbits(31)
    names = ("width", "draws", "effects", "training", "epochs")
    return Kept(out, {"seed": seed} | {k: getattr(args, k) for k in names}), seed


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", type=str.capitalize, default=["Jackal", "Ant"],
                        choices=("Jackal", "Ant", "Quadruped", "Humanoid", "Quadcopter"),
                        help="default Jackal Ant")  # fmt: skip
    parser.add_argument("--out", type=Path, metavar="DIR", help="keeps finished parts: a stopped run goes on")
    parser.add_argument("--nominal", type=count(1), default=10_000, help="windows that false alarms are counted on")
    parser.add_argument(
        "--held-out", type=count(1), default=5000, help="nominal windows that thresholds are taken from"
    )
    parser.add_argument("--faulty", type=count(1), default=500, help="windows of each fault and size")
    parser.add_argument("--training", type=count(1), default=20_000, help="nominal windows of the contrastive net")
    parser.add_argument("--epochs", type=count(1), default=30, help="of the contrastive net")
    parser.add_argument("--effects", type=count(0), default=6, help="effects of the library, drawn")
    parser.add_argument("--levels", type=count(0), default=2000, help="nominal windows that level the bank's faults")
    parser.add_argument(
        "--lessons",
        type=count(1),
        default=1000,
        help="windows with drawn faults, beside those of --levels: what the bank's judge learns from",
    )
    parser.add_argument("--draws", type=count(1), default=32, help="replays a window; of each machine in the bank half")
    parser.add_argument("--width", type=number(0, 1), default=0.02, help="of psi about nominal, in the prior's range")
    parser.add_argument("--seed", type=count(0), help="default drawn, or the one that --out was begun with; printed")
    parser.add_argument("--jobs", type=count(1), default=1, help="processes that replay")
    parser.add_argument("--device", default="cpu", help="that the contrastive net learns on: cpu or cuda")
    parser.add_argument(
        "--stop",
        type=number(0),
        metavar="SECONDS",
        help="begin no new part after that time; the net's training is not cut",
    )
    parser.add_argument("--quick", action="store_true", help="Jackal alone, a few windows and faults: says little")
    parser.add_argument(
        "--json",
        type=json_file,
        metavar="FILE",
        help="write the rows here: a list of {name, value, unit, baseline, goal, holds, seeds}",
    )
    args = parser.parse_args()
    if args.quick:
        args.robots, args.nominal, args.held_out, args.faulty = ["Jackal"], 4, 4, 2
        args.training, args.epochs, args.effects, args.draws, args.levels = 64, 1, 1, 2, 50
        args.lessons = 50
    return args


if __name__ == "__main__":
    sys.exit(ended(main))
