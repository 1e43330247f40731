"""A bank of replays: does a fault that one can name explain a window better than the machine as it is believed to be?

The mean X of one replay asks whether *anything* is wrong, in every direction that motion has; a fault moves it in one.
The likelihood ratio of two machines asks in that direction alone, and is the most powerful test there is between them
(Neyman and Pearson 1933). So the window is replayed under the belief and under the belief with each of a few faults
(multiple-model estimation: Magill 1965), and the score is

    max over faults of sum over control steps of [l(step | fault) - l(step | belief)],

in nats, l being the Gaussian log likelihood of the step's error given all before it (`replay`). What a fault of another
size does lies mostly in the direction of the one in the bank, so that one size of each will do. The last alternative is
no fault in particular: errors with twice the variance, which costs no replay.

What all of them say together tells more than the greatest: see `judge`.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.posterior import Sampler
from nfc_gym.physics.effects import Effect, build
from nfc_gym.simulate.judge import Judge
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.replay import MOST, SETTLE, Replay

Array = NDArray[np.float64]
DRAWS = 16  # replays of each machine
HEAVY, LIGHT, SLIPPERY, LOST, WEAK = 1.6, 0.6, 0.45, 0.1, 0.7  # times main mass, friction, gain of a servo or a motor
_ACTUATORS = 8  # of a robot with more, no single one is in the bank
_WIDER = 2.0  # times the errors' variance: something else
ELSE = "something else"


@dataclass(frozen=True)
class Fault:
    """What may be wrong with a machine.

    Attributes:
      name: in words.
      scale: (d,) times psi.
      lacks: an effect that it has beyond the model, with its parameters (k,).
    """

    name: str
    scale: Array
    lacks: tuple[Effect, Array] | None = None


def faults_of(machine: Machine) -> list[Fault]:
    """The main body heavier or lighter, less friction where psi has it, and each of a few actuators lost or weak."""
    names, ones = machine.space.names, np.ones(len(machine.space))

    def scaled(which: Sequence[str], by: float) -> Array:
        return np.where([n in which for n in names], by, ones)

    body = next(n for n in names if n.endswith("_mass"))
    out = [Fault(f"{body} x {k:g}", scaled([body], k)) for k in (HEAVY, LIGHT)]
    rubbing = [n for n in names if n.endswith("_friction")]
    if rubbing:
        out.append(Fault(f"friction x {SLIPPERY:g}", scaled(rubbing, SLIPPERY)))
    servos = [n for n in names if n.endswith("_damping")]  # the gain of a wheel's servo
    out += [Fault(f"{n} x {LOST:g}", scaled([n], LOST)) for n in servos]
    if not servos and machine.model.nu <= _ACTUATORS:
        for i in range(machine.model.nu):
            name = machine.model.actuator(i).name
            out.append(Fault(f"gain of {name} x {WEAK:g}", ones, build("loss", name, {"fraction": 1 - WEAK})))
    return out


class ReplayBank:
    """Scores windows by the likeliest of a few faults; a `WindowScore` of `inference.detector`.

    Args:
      environment: id, `nfc_gym/JackalFlat-v0`.
      belief: what psi is drawn from, see `Replay`.
      faults: what is asked for; default `faults_of` the robot.
      draws: replays of each machine, the healthy one and each faulty one.
      given: the rest of `Replay`'s arguments.

    Attributes:
      names: of the faults, and last `ELSE`.
      offset: (len(names),) nats taken off each, see `levelled`.
      judge: of all evidence together, see `judged`; None takes the greatest gain less its offset.

    Raises:
      InputError: as of `Replay`; faults of another robot, or none.
    """

    def __init__(
        self, environment: str, belief: Sampler | None = None, faults: Sequence[Fault] | None = None, *,
        draws: int = DRAWS, **given: Any,
    ) -> None:  # fmt: skip
        self.believed = Replay(environment, belief, draws=draws, **given)
        asked = faults_of(self.believed.machine) if faults is None else list(faults)
        if not asked:
            raise InputError("replay bank: no faults; leave `faults` out for those of the robot")
        self.faulty = [self.believed.under(f.scale, f.lacks) for f in asked]
        self.names = (*(f.name for f in asked), ELSE)
        self.offset = np.zeros(len(self.names))
        self.judge: Judge | None = None
        self.horizon, self.states, self.actions = self.believed.horizon, self.believed.states, self.believed.actions

    def score(
        self, states: Array, actions: Array, start: Array | None = None, which: NDArray[np.intp] | None = None
    ) -> Array:
        """(n,) the judge's log odds, or nats by which the likeliest fault explains windows better.

        Arguments as of `Replay.told_of`.
        """
        if self.judge is not None:
            return self.judge.odds(self.evidence(states, actions, start, which))
        return (self.gains(states, actions, start, which) - self.offset).max(1)

    def levelled(self, states: Array, actions: Array, start: Array | None = None, rate: float = 0.01) -> "ReplayBank":
        """The same with an offset for each fault, at which it alone would be believed in a share `rate` of windows.

        Some faults hardly ever look likely where there is none, and a small gain of theirs tells much: under one limit
        for all, the fault that a healthy machine comes nearest to would set it.

        Args:
          states, actions, start: (n, ...) nominal windows; not those that a threshold is then taken from.
          rate: a share.

        Raises:
          InputError: fewer windows than 1 / rate.
        """
        if not 0 < rate < 1 or len(states) * rate < 1:
            raise InputError(
                f"replay bank: {len(states)} windows do not show a share of {rate:g}; want 1 / rate or more"
            )
        out = copy(self)
        out.offset = np.quantile(self.gains(states, actions, start), 1 - rate, axis=0)
        return out

    def judged(self, healthy: Array, faulty: Array) -> "ReplayBank":
        """The same with a judge of all evidence together.

        Args:
          healthy, faulty: (n, e) and (m, e) `evidence` of windows without and with a fault, a thousand or more of each:
            `trials` and `faulty` make them. Not those that a threshold is then taken from.

        Raises:
          InputError: as of `Judge.learned`.
        """
        out = copy(self)
        out.judge = Judge.learned(healthy, faulty)
        return out

    def score_rows(self, states: Array, actions: Array, rows: NDArray[np.intp]) -> Array:
        """The same for windows of some rows of a vector environment, each on the map that it stands on."""
        standing = self.believed.standing
        return self.score(states, actions, which=None if standing is None else np.asarray(standing())[rows])

    def gains(
        self, states: Array, actions: Array, start: Array | None = None, which: NDArray[np.intp] | None = None
    ) -> Array:
        """(n, len(names)) nats by which each of `names` explains a window better than the belief does."""
        return self.evidence(states, actions, start, which)[:, : len(self.names)]

    def evidence(
        self, states: Array, actions: Array, start: Array | None = None, which: NDArray[np.intp] | None = None
    ) -> Array:
        """(n, len(names) + 2) the `gains`, and what the belief leaves unexplained, see `unexplained`."""
        k = len(self.believed.told)
        found = self.believed.told_of(states, actions, start, which)[:, SETTLE:]
        squared, log_det = _cut(found, k)
        wider = (squared / _WIDER + log_det + k * np.log(_WIDER)).sum(1)
        others = [sum(_cut(r.told_of(states, actions, start, which)[:, SETTLE:], k)).sum(1) for r in self.faulty]
        gains = ((squared + log_det).sum(1)[:, None] - np.stack([*others, wider], 1)) / 2
        mean = np.stack([squared.mean(1), found[..., 0].mean(1)], 1) / k
        return np.concatenate([gains, self.unexplained(mean)], 1)

    def unexplained(self, x: Array) -> Array:
        """Nats from a mean X of a window's steps: what chi^2 / 2 exceeds its expectation by where X = 1 is expected."""
        return (x - 1) * len(self.believed.told) * (self.horizon - SETTLE) / 2


def _cut(found: Array, k: int) -> tuple[Array, Array]:
    """(n, H - SETTLE) e' Sigma^-1 e, cut as the mean X is, and log det Sigma."""
    return np.minimum(found[..., 0], MOST * k), found[..., 1]
