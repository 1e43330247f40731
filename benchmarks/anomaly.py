"""Anomaly detectors on simulated windows with and without faults: what is found, and at which price.

    python benchmarks/anomaly.py [--quick] [--robots Jackal Ant ...] [--nominal N] [--held-out N] [--faulty N]
                                 [--training N] [--epochs N] [--effects N] [--draws N] [--levels N] [--width W]
                                 [--seed S] [--json FILE]

Every machine's psi is drawn within `--width` of the prior's range about nominal, and the replay believes that
distribution and no more. Faults: main mass, an actuator's gain, friction, and effects of the library drawn at run
time, each at several sizes; X / X_null says how far a size drives the replay's mean X. Thresholds come from held-out
nominal windows; rates that those cannot show are named and left out. Windows count one by one, nothing is adjusted
for neighbours. The baseline is an unconditional test: the distance of a window's means and deviations, of states and
their steps, from those of nominal training windows, at the same false-positive rate.
"""

import argparse
import json
import os
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from numpy.typing import NDArray
from timing import Table

from nfc_gym.core import Fidelity, InputError
from nfc_gym.inference.contrast import Contrast
from nfc_gym.inference.data import TensorWindows
from nfc_gym.inference.rates import auroc, rate_above, threshold_at
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import TrainConfig, train
from nfc_gym.physics.effects import Effect, build
from nfc_gym.physics.effects.base import Param
from nfc_gym.physics.fields import ModelFields
from nfc_gym.simulate.bank import ReplayBank
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.replay import Replay
from nfc_gym.simulate.residuals import candidates, sizes
from nfc_gym.simulate.start import disturbed
from nfc_gym.simulate.trials import trials

Array = NDArray[np.float64]
RATES = (0.05, 0.01, 0.001)
MASS, GAIN, FRICTION = (2.0, 1.5, 1.25, 1.1), (0.0, 0.25, 0.5, 0.75), (0.3, 0.5, 0.7, 0.9)
LEVEL = 0.01  # share of nominal windows in which each fault of the bank alone would be believed
EFFECT = (1.0, 0.3, 3.0)  # times the size drawn
GOAL, STRONG = 0.995, 5.0  # rate found at a false-positive rate of 0.001; X / X_null from which an effect has that goal


class Friction(Effect):
    """Sliding friction of every geom times a factor, for robots whose psi has none."""

    family = "benchmark_friction"

    def model(self, fields: ModelFields, theta: Array) -> None:
        """See `Effect`."""
        fields["geom_friction"][..., 0] *= theta[..., :1]


@dataclass(frozen=True)
class Fault:
    """What is wrong with a machine: `scale` (d,) multiplies psi; `theta` (k,) of an effect."""

    name: str
    scale: Array
    effect: Effect | None = None
    theta: Array | None = None
    wanted: bool = False  # whether the goal is set for it, its X / X_null aside


def faults(machine: Machine, effects: int, rng: np.random.Generator) -> list[Fault]:
    """Of all kinds and sizes."""
    names, ones = machine.space.names, np.ones(len(machine.space))

    def scaled(which: list[str], by: float) -> Array:
        return np.where([n in which for n in names], by, ones)

    body = next(n for n in names if n.endswith("_mass"))
    out = [Fault(f"{body} x {k:g}", scaled([body], k), wanted=k == MASS[0]) for k in MASS]
    servos = [n for n in names if n.endswith("_damping")]
    for k in GAIN:
        if servos:
            out.append(Fault(f"{servos[0]} x {k:g}", scaled(servos[:1], k), wanted=k == GAIN[0]))
        else:
            actuator = machine.model.actuator(0).name
            loss, theta = build("loss", actuator, {"fraction": 1 - k})
            out.append(Fault(f"gain of {actuator} x {k:g}", ones, loss, theta, wanted=k == GAIN[0]))
    own = [n for n in names if n.endswith("_friction")]
    for k in FRICTION:
        slippery = None if own else Friction(("ground",), (Param("factor", "1", 0.0, 1.0, null=1.0),))
        by, theta = (scaled(own, k), None) if own else (ones, np.array([k]))
        out.append(Fault(f"friction x {k:g}", by, slippery, theta, wanted=k == FRICTION[0]))
    library = candidates(machine)
    for i in rng.choice(len(library), min(effects, len(library)), replace=False):
        one = library[i]
        size = sizes(one, rng.random((1, 2 * len(one.params))))[0]
        low, high = np.array([(p.low, p.high) for p in one.params]).T
        for k in EFFECT:
            theta = np.clip(np.where([p.shape for p in one.params], size, one.null + k * (size - one.null)), low, high)
            said = ", ".join(f"{p.name} {v:.3g} {p.unit}" for p, v in zip(one.params, theta, strict=True))
            out.append(Fault(f"{one.family}:{'+'.join(one.where)} {said}", ones, one, theta))
    return out


class Unconditional:
    """Mahalanobis distance of a window's means and deviations from those of training windows."""

    def __init__(self, windows: dict[str, NDArray]) -> None:
        x = self.summaries(windows)
        self.mean = x.mean(0)
        scale = x.std(0) + 1e-9
        covariance = np.cov((x / scale).T) + 0.05 * np.eye(x.shape[1])  # a ridge, few windows having many summaries
        self.root = np.linalg.inv(np.linalg.cholesky(covariance)) / scale

    @staticmethod
    def summaries(windows: dict[str, NDArray]) -> Array:
        """(n, 4 s)."""
        s = windows["states"]
        d = np.diff(s, axis=1)
        return np.concatenate([s.mean(1), s.std(1), d.mean(1), d.std(1)], 1)

    def score(self, windows: dict[str, NDArray]) -> Array:
        """(n,)."""
        return (((self.summaries(windows) - self.mean) @ self.root.T) ** 2).sum(1)


class Bench:
    """One robot: its machines, and the detectors' scores of their windows."""

    def __init__(self, robot: str, args: argparse.Namespace) -> None:
        self.machine, self.args = Machine(f"nfc_gym/{robot}Flat-v0"), args
        self.rng = np.random.default_rng(args.seed)
        self.count = 0
        training = self.windows(None, args.training)
        belief = Fidelity(psi=self.psi(512))
        self.replay = Replay(self.machine.environment, belief, draws=args.draws, seed=args.seed)
        bank = ReplayBank(self.machine.environment, belief, draws=max(2, args.draws // 2), seed=args.seed)
        self.bank = bank.levelled(*self.started(self.windows(None, args.levels)), rate=LEVEL)
        self.plain = Unconditional(training)
        tensors = {k: torch.as_tensor(training[k], dtype=torch.float32) for k in ("states", "actions")}
        space = self.machine.space
        tensors["psi"] = torch.as_tensor((training["psi"] - space.low) / (space.high - space.low), dtype=torch.float32)
        windows = TensorWindows(tensors)
        self.contrast = Contrast.of(tensors, PriorBox.of(space, self.machine.kind.name), seed=args.seed)
        outcome = train(
            self.contrast, *windows.split(0.1), TrainConfig(epochs=args.epochs, batch=64, warmup=20, seed=args.seed)
        )
        print(f"{robot}: contrast net: {outcome.stopped} after {len(outcome.train)} epochs, best {outcome.best}, "
              f"held-out loss {outcome.start:.3f} -> {min(outcome.held_out):.3f}", flush=True)  # fmt: skip

    def psi(self, n: int) -> Array:
        """(n, d) about nominal."""
        space = self.machine.space
        width = self.args.width * (space.high - space.low)
        return np.clip(space.nominal + width * self.rng.uniform(-1, 1, (n, len(space))), space.low, space.high)

    def windows(self, fault: Fault | None, n: int) -> dict[str, NDArray]:
        """n windows, each of a machine of its own."""
        self.count += 1
        psi, given = self.psi(n), {}
        if fault is not None:
            psi = psi * fault.scale
            if fault.effect is not None and fault.theta is not None:
                fault.effect.bind(self.machine.model)
                given = {"effect": fault.effect, "theta": np.tile(fault.theta, (n, 1))}
        return trials(self.machine, psi, 1000 * self.args.seed + self.count, **given)

    def started(self, windows: dict[str, NDArray]) -> tuple[Array, Array, Array | None]:
        """States, actions, and a state estimate of the start of robots that do not observe their whole state."""
        model, start = self.machine.model, None
        if self.machine.kind.name not in ("jackal", "quadcopter"):
            true = windows["start"][:, 1 : 1 + model.nq + model.nv]
            start = disturbed(self.machine, true, self.rng.standard_normal((len(true), 2 * model.nv)))
        return windows["states"], windows["actions"], start

    def scores(self, windows: dict[str, NDArray]) -> dict[str, Array]:
        """(n,) of each detector, and the mean X, not cut, as `x`."""
        started = self.started(windows)
        steps = self.replay.steps(*started)
        return {
            "replay": self.replay.summed(steps),
            "bank": self.bank.score(*started),
            "contrast": self.contrast.score(windows["states"], windows["actions"]),
            "unconditional": self.plain.score(windows),
            "x": steps.mean(1),
        }


def measure(table: Table, robot: str, args: argparse.Namespace) -> None:
    """All rows of one robot."""
    bench, seeds = Bench(robot, args), (args.seed,)
    held, nominal = (bench.scores(bench.windows(None, n)) for n in (args.held_out, args.nominal))
    names = ("replay", "bank", "contrast", "unconditional")
    unit = {k: np.quantile(held[k], 0.95) for k in ("replay", "contrast")}
    for scores in (held, nominal):
        scores["either"] = np.maximum(scores["replay"] / unit["replay"], scores["contrast"] / unit["contrast"])
    limits: dict[float, dict[str, float]] = {}
    for rate in RATES:
        try:
            limits[rate] = {k: threshold_at(held[k], rate).value for k in (*names, "either")}
        except InputError as e:
            print(f"{robot}: {e}", flush=True)
            continue
        for k in (*names, "either"):
            found, error = rate_above(nominal[k], limits[rate][k])
            what = f"{robot}, {k}: false-positive rate on other windows, wanted {rate:g} (+- {error:.2g})"
            table.add(what, found, "1", seeds=seeds)
    null = float(np.median(nominal["x"]))
    table.add(f"{robot}: median X of nominal windows", null, "1", seeds=seeds)
    for fault in faults(bench.machine, args.effects, bench.rng):
        windows = bench.windows(fault, args.faulty)
        if len(windows["states"]) < args.faulty / 2:
            print(f"{robot}, {fault.name}: throws the robot at once ({len(windows['states'])} windows left); left out")
            continue
        faulty = bench.scores(windows)
        faulty["either"] = np.maximum(faulty["replay"] / unit["replay"], faulty["contrast"] / unit["contrast"])
        strength = float(np.median(faulty["x"])) / null
        strong = replace(fault, wanted=fault.wanted or (fault.effect is not None and strength >= STRONG))
        report(table, f"{robot}, {fault.name}, X/X_null {strength:.2f}", strong, nominal, faulty, limits, seeds)


def report(
    table: Table, name: str, fault: Fault, nominal: dict[str, Array], faulty: dict[str, Array],
    limits: dict[float, dict[str, float]], seeds: tuple[int, ...],
) -> None:  # fmt: skip
    """Rows of one fault at one size."""
    base = auroc(nominal["unconditional"], faulty["unconditional"])[0]
    for k in ("replay", "bank", "contrast", "either"):
        area, error = auroc(nominal[k], faulty[k])
        table.add(f"{name}: AUROC, {k} (+- {error:.2g})", area, "1", baseline=base, seeds=seeds)
        for rate, limit in limits.items():
            found, error = rate_above(faulty[k], limit[k])
            other = rate_above(faulty["unconditional"], limit["unconditional"])[0]
            goal = GOAL if fault.wanted and rate == min(RATES) and k != "contrast" else None
            table.add(f"{name}: TPR at FPR {rate:g}, {k} (+- {error:.2g})", found, "1", baseline=other, at_least=goal,
                      seeds=seeds)  # fmt: skip


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", default=["Jackal", "Ant"],
                        choices=("Jackal", "Ant", "Quadruped", "Humanoid", "Quadcopter"))  # fmt: skip
    parser.add_argument("--nominal", type=int, default=10_000, help="windows that false alarms are counted on")
    parser.add_argument("--held-out", type=int, default=5000, help="nominal windows that thresholds are taken from")
    parser.add_argument("--faulty", type=int, default=500, help="windows of each fault and size")
    parser.add_argument("--training", type=int, default=20_000, help="nominal windows of the contrastive net")
    parser.add_argument("--epochs", type=int, default=30, help="of the contrastive net")
    parser.add_argument("--effects", type=int, default=6, help="effects of the library, drawn")
    parser.add_argument("--levels", type=int, default=1000, help="nominal windows that level the bank's faults")
    parser.add_argument("--draws", type=int, default=32, help="replays a window; of each machine in the bank half")
    parser.add_argument("--width", type=float, default=0.02, help="of psi about nominal, in the prior's range")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="Jackal alone, a few windows: a minute, and says little")
    parser.add_argument("--json", type=Path, help="write the rows here")
    args = parser.parse_args()
    if args.quick:
        args.robots, args.nominal, args.held_out, args.faulty = ["Jackal"], 64, 64, 8
        args.training, args.epochs, args.effects, args.draws, args.levels = 256, 1, 1, 4, 100
    torch.set_num_threads(1)
    table = Table()
    for robot in args.robots:
        measure(table, robot, args)
    if args.json:
        args.json.write_text(json.dumps([asdict(r) for r in table.rows], indent=1))


if __name__ == "__main__":
    sys.exit(main())
