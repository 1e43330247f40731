"""X / X_null of a fault: how far off the bare model's replays of its windows are, and at what size it is strong."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from anomalies.faults import Fault, drawn, grown, most_of, told
from nfc_gym.core import Fidelity
from nfc_gym.inference.windows import Batch
from nfc_gym.physics.effects import Effect
from nfc_gym.simulate.faulty import about_nominal
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.replay import Replay
from nfc_gym.simulate.start import disturbed
from nfc_gym.simulate.trials import trials

Array = NDArray[np.float64]
STRONG = 5.0  # X / X_null from which an effect has the goal
_WINDOWS, _DRAWS = 12, 12  # of a size, and replays of each
_HALVINGS = 3  # of the interval in which an effect becomes strong
_ENOUGH = 1.5  # times STRONG: no smaller size is looked for below it


def start_of(machine: Machine, windows: Batch, rng: np.random.Generator) -> Array | None:
    """(n, nq + nv) measured starts of windows; None for robots that observe their whole state."""
    if machine.kind.name in ("jackal", "quadcopter"):
        return None
    true = windows["start"][:, 1 : 1 + machine.model.nq + machine.model.nv]
    return disturbed(machine, true, rng.standard_normal((len(true), 2 * machine.model.nv)))


class Yardstick:
    """X / X_null of effects on one robot, over a few windows that are alike for all sizes.

    X is the mean over a window of the replays' error, whitened by the sensors' noise and the replays' own spread, its
    median over windows; X_null is that of windows without an effect.

    Args:
      machine: the robot, on a plane.
      width: of psi about nominal, in the prior's range; what the replays believe.
      seed: of machines, motion and replays.
    """

    def __init__(self, machine: Machine, width: float, seed: int) -> None:
        self.machine, self.seed = machine, seed
        rng = np.random.default_rng(seed)
        belief = Fidelity(psi=about_nominal(machine.space, width, 256, rng))
        self.psi = about_nominal(machine.space, width, _WINDOWS, rng)
        self.replay = Replay(machine.environment, belief, draws=_DRAWS, seed=seed)
        self.null = self._x()

    def __call__(self, effect: Effect, theta: Array) -> float:
        """X / X_null under parameters theta (k,); infinite where most windows end early."""
        effect.bind(self.machine.model)
        return self._x(effect=effect, theta=np.tile(theta, (_WINDOWS, 1))) / self.null

    def _x(self, **given: Effect | Array) -> float:
        windows = trials(self.machine, self.psi, self.seed, **given)  # type: ignore[arg-type]
        if len(windows["states"]) < _WINDOWS / 2:
            return math.inf
        start = start_of(self.machine, windows, np.random.default_rng(self.seed))
        return float(np.median(self.replay.steps(windows["states"], windows["actions"], start).mean(1)))


def reaching(ratio: Callable[[float], float], most: float) -> tuple[float, float]:
    """How many times its size an effect is strong at, by doubling and halving, and its X / X_null there.

    The size is doubled until the ratio is `STRONG`, `most` times at most; then the interval is halved a few times. The
    ratio that is given is less than `STRONG` where `most` comes first, and infinite where every strong size ends most
    windows early.
    """
    low, high = 0.0, min(1.0, most)
    found = ratio(high)
    while found < STRONG and high < most:
        low, high = high, min(2 * high, most)
        found = ratio(high)
    for _ in range(_HALVINGS):
        if found <= _ENOUGH * STRONG:  # one that never was strong too
            break
        middle = (low + high) / 2
        between = ratio(middle)
        if between < STRONG:
            low = middle
        else:
            high, found = middle, between
    return high, found


def strong(machine: Machine, effects: int, rng: np.random.Generator, width: float, seed: int) -> list[Fault]:
    """The effects that `faults` draws from such a generator, each at a size at which X / X_null is `STRONG` or more.

    Those that no size within their bounds makes so strong are left out, which is said.
    """
    library, out = drawn(machine, effects, rng), []
    yardstick = Yardstick(machine, width, seed) if library else None
    for effect, size in library:
        factor, ratio = reaching(lambda k, e=effect, s=size: yardstick(e, grown(e, s, k)), most_of(effect, size))
        theta = grown(effect, size, factor)
        name = f"{told(effect, theta)}, X / X_null {ratio:.1f}"
        if STRONG <= ratio < math.inf:
            out.append(Fault(name, np.ones(len(machine.space)), effect, theta, wanted=True))
        else:
            why = "at its bounds" if ratio < STRONG else "throws the robot at once"
            print(f"{machine.kind.name}, {name}: {why}; left out of the strong ones", flush=True)
    return out
