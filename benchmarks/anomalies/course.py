"""Windows of one robot, each of a machine of its own, and the replays' scores of them; a part at a time.

A part is a pure function of its settings: it may be simulated anew wherever it is needed, in any process.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from anomalies.faults import Fault, faults
from anomalies.strength import start_of
from nfc_gym.core import Fidelity
from nfc_gym.inference.windows import Batch
from nfc_gym.simulate.bank import ReplayBank, faults_of
from nfc_gym.simulate.faulty import about_nominal, faulty
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.replay import Replay
from nfc_gym.simulate.trials import trials

Array = NDArray[np.float64]
PART = 50  # windows: a minute of the replays, so that an interrupted run loses little
ROLES = ("training", "levels", "held out", "nominal", "faulty", "lessons")


@dataclass(frozen=True)
class Settings:
    """What every figure of a robot depends on.

    Attributes:
      robot: its name.
      seed: of everything.
      width: of psi about nominal, in the prior's range; what the replay believes.
      draws: replays a window; of each machine in the bank half.
      effects: of the library, drawn.
      toy: whether every fourth fault is tried alone, with two in the bank.
    """

    robot: str
    seed: int
    width: float
    draws: int
    effects: int
    toy: bool = False


@dataclass(frozen=True)
class Part:
    """`size` windows that have a role; of the fault of that number, if the role is faulty."""

    role: str
    number: int
    size: int = PART
    fault: int = 0

    @property
    def name(self) -> str:
        """Of its file."""
        fault = f"_{self.fault}" if self.role == "faulty" else ""
        return f"{self.role.replace(' ', '_')}{fault}_{self.number}_{self.size}"


def parts(role: str, count: int, fault: int = 0) -> list[Part]:
    """`count` windows in parts."""
    return [Part(role, i, min(PART, count - i * PART), fault) for i in range(-(-count // PART))]


class Course:
    """One robot: its faults, its windows, and what the replays say of them."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.machine = Machine(f"nfc_gym/{settings.robot}Flat-v0")
        found = faults(self.machine, settings.effects, np.random.default_rng([settings.seed, 0]))
        self.faults: list[Fault] = found[::4] if settings.toy else found
        asked = faults_of(self.machine)[:2] if settings.toy else None
        belief = Fidelity(psi=self._psi(512, np.random.default_rng([settings.seed, 1])))
        env, draws, seed = self.machine.environment, settings.draws, settings.seed
        self.replay = Replay(env, belief, draws=draws, seed=seed)
        self.bank = ReplayBank(env, belief, asked, draws=max(2, draws // 2), seed=seed)

    def windows(self, part: Part) -> Batch:
        """Of a part; fewer than its size where a fault throws the robot at once."""
        entropy = [self.settings.seed, 2, ROLES.index(part.role), part.fault, part.number]
        rng = np.random.default_rng(entropy)
        psi, given = self._psi(part.size, rng), {}
        if part.role == "lessons":
            return faulty(self.machine, psi, int(rng.integers(2**31)))
        if part.role == "faulty":
            fault = self.faults[part.fault]
            psi = psi * fault.scale
            if fault.effect is not None and fault.theta is not None:
                fault.effect.bind(self.machine.model)
                given = {"effect": fault.effect, "theta": np.tile(fault.theta, (part.size, 1))}
        return trials(self.machine, psi, int(rng.integers(2**31)), **given)

    def replayed(self, part: Part) -> dict[str, list]:
        """`replay` (n,), its mean X, not cut, as `x`, and the `gains` (n, names) of the bank."""
        windows = self.windows(part)
        rng = np.random.default_rng([self.settings.seed, 3, ROLES.index(part.role), part.fault, part.number])
        start = start_of(self.machine, windows, rng)
        steps = self.replay.steps(windows["states"], windows["actions"], start)
        gains = self.bank.gains(windows["states"], windows["actions"], start)
        found = {"replay": self.replay.summed(steps), "x": steps.mean(1), "gains": gains}
        return {k: np.nan_to_num(v, posinf=1e300, neginf=-1e300).tolist() for k, v in found.items()}

    def _psi(self, n: int, rng: np.random.Generator) -> Array:
        """(n, d) about nominal."""
        return about_nominal(self.machine.space, self.settings.width, n, rng)


@lru_cache(maxsize=1)
def course(settings: Settings) -> Course:
    """One a process: its simulations are kept from part to part."""
    return Course(settings)


def replayed(settings: Settings, part: Part) -> dict[str, list]:
    """See `Course.replayed`; of a process of its own."""
    return course(settings).replayed(part)
