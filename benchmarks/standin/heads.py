"""A structure head for a stand-in: windows under the psi that its mapping declares, training, and what the head tells.

The environment of the same robot makes the windows. Its parameters that the mapping declares are drawn from the
mapping's bounds, those of one make together; the weighed one is off by as much as stand-ins are; others are nominal.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from posteriors.metrics import area

from nfc_gym.core import Fidelity
from nfc_gym.inference.evidence import told_by
from nfc_gym.inference.progress import Spoken
from nfc_gym.inference.windows import Windows
from nfc_gym.measured.hidden import Array
from nfc_gym.simulate import simulate
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.misfit import of_windows
from nfc_gym.simulate.teach import NETWORK, TRAINING, train_structure
from nfc_gym.simulate.witness import Witness

from .robots import ROBOTS

ENVIRONMENTS = {"quadcopter": "nfc_gym/QuadcopterFlat-v0", "jackal": "nfc_gym/JackalFlat-v0"}
NOISE = {"quadcopter": 0.35, "jackal": 0.35}  # times the environment's sensor noise: about the stand-ins' own gyroscope
MOTOR = 0.002  # of the motors' range; a stand-in's motors make what they are told
EFFECTS = 0.75  # share of windows with one
STRONG = 2.0  # X / X_null from which a head must see an effect
_WEIGHED = 0.15  # how far stand-ins' parameters lie from nominal
_RARE = 20  # windows of a family with a strong effect, below which no area is given for it


@dataclass(frozen=True)
class Course:
    """How a head is taught.

    Attributes:
      windows: to train on.
      judged: of a set of their own, to judge it on.
      epochs: at most.
      small: a toy's network.
      mirror: whether windows are shown in the robot's mirrors too.
    """

    windows: int = 40_960
    judged: int = 2048
    epochs: int = TRAINING.epochs
    small: bool = False
    mirror: bool = True


class Declared:
    """Draws of psi as a stand-in's mapping declares it; a proposal for `simulate`.

    Args:
      robot: a stand-in.
    """

    def __init__(self, robot: str) -> None:
        self.space = Machine(ENVIRONMENTS[robot]).space
        kit = ROBOTS[robot]
        mapping = yaml.safe_load(kit.mapping(kit.psi[kit.weighed]))
        own = self.space.parameters
        self.groups: list[tuple[list[int], float, float]] = []
        for p in mapping["parameters"]:
            at = [i for i, q in enumerate(own) if q.field == p["field"] and set(q.of) <= set(p["of"])]
            low, high = p["low"], p["high"]
            if p.get("anchored"):
                low, high = (p["nominal"] * f for f in (1 - _WEIGHED, 1 + _WEIGHED))
            if at:
                self.groups.append((at, low, high))

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        """`n` draws, psi alone."""
        psi = np.tile(self.space.nominal, (n, 1))
        for at, low, high in self.groups:
            psi[:, at] = rng.uniform(low, high, n)[:, None]
        return Fidelity(np.clip(psi, self.space.low, self.space.high))


def taught(robot: str, course: Course, folder: Path, seed: int, jobs: int = 1, device: str = "cpu") -> Path:
    """The head's file, from windows that `jobs` processes simulate; what is there already is not made again."""
    head = folder / f"{robot}.safetensors"
    if not head.exists():
        windows = _windows(robot, Declared(robot), course.windows, folder / f"{robot}_windows", seed, jobs)
        config = replace(NETWORK, encoder="nn", width=64, features=64, hidden=64) if course.small else NETWORK
        train_structure(
            windows.folders[0], head, replace(TRAINING, epochs=course.epochs, seed=seed),
            config=config, noise=NOISE[robot], device=device, threads=jobs, mirror=course.mirror, report=Spoken(),
        )  # fmt: skip
    return head


def judged(robot: str, head: Path, course: Course, folder: Path, seed: int, jobs: int = 1) -> dict[str, Any]:
    """What a head tells of single windows that it never saw.

    X is the mean square misfit of a window in standard deviations of the sensors, with psi, start and noise as off as
    in training; X_null its median without an effect. Areas are of 1 - P(none), effects against none, and the mean over
    families of P(family), windows with it against all others.
    """
    witness = Witness(head)
    windows = _windows(robot, Declared(robot), course.judged, folder / f"{robot}_judged", seed + 1, jobs)
    rows, machine = np.arange(len(windows)), witness.machine
    states, fine = of_windows(machine, windows, rows, NOISE[robot], np.random.default_rng(seed + 1), jobs)
    batch = windows.take(rows[fine], ["actions", "family"])
    states, family = states[fine], batch["family"]
    told = told_by(witness.network, states.astype(float), batch["actions"].astype(float))
    x = mean_square(states)
    ratio, score = x / np.median(x[family == 0]), 1 - told[:, 0]
    strong = (family > 0) & (ratio >= STRONG)
    chosen = strong | (family == 0)
    each = [
        area(told[chosen, k], (family == k)[chosen])
        for k in range(1, len(witness.families))
        if (strong & (family == k)).sum() >= _RARE
    ]
    first = np.argsort(-told[:, 1:], axis=1)[:, :3] + 1
    return {
        "windows": len(family),
        "strong": int(strong.sum()),
        "area": area(score[chosen], strong[chosen]),
        "area_all": area(score, family > 0),
        "area_of_x": area(x[chosen], strong[chosen]),
        "one_vs_rest": float(np.mean(each)) if each else float("nan"),
        "families": len(each),
        "among_three": float((first[strong] == family[strong, None]).any(1).mean()) if strong.any() else float("nan"),
    }


def mean_square(states: Array) -> Array:
    """(W,) X of windows of motion and misfit (W, H+1, 2 s); a misfit of more than 50 counts as 50."""
    missed = np.sinh(states[:, 1:, states.shape[2] // 2 :].astype(float))
    return (np.clip(missed, -50, 50) ** 2).mean((1, 2))


def _windows(robot: str, declared: Declared, count: int, folder: Path, seed: int, jobs: int = 1) -> Windows:
    return simulate(
        ENVIRONMENTS[robot], count, folder, seed=seed, jobs=jobs, effects=EFFECTS, proposal=declared, motor=MOTOR,
        per_shard=min(count, 2048),
    )  # fmt: skip


def threads(count: int) -> None:
    """Threads of torch; more than the cores that are free only wait for each other."""
    torch.set_num_threads(count)
