"""A foreign machine as its user knows it, how it is moved, and what it may hide."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from .channels import Channel, Control, Signal
from .effect import Array, Effect, Rng
from .parameters import Parameter

MODELS = Path(__file__).parent / "models"

Policy = Callable[[float, mujoco.MjData], Array | Sequence[float]]  # (seconds since the log's start, state) -> (nu,)
Start = Callable[[mujoco.MjData], None]  # puts the state at the beginning
Make = Callable[[float], Sequence[Effect]]  # the effects of a size
Hide = Callable[[Rng], Make]  # draws all of them but the size


@dataclass(frozen=True)
class Motion:
    """How one log is moved: `policy`, from a state that `start` sets (else the model's own)."""

    policy: Policy
    start: Start | None = None


@dataclass(frozen=True)
class Format:
    """How a log is written.

    Attributes:
      suffix: `csv` or `npz`.
      separator: of a CSV file.
      clock: unit of the stamps.
      epoch: what the stamps begin with, s.
      uneven: rows are up to this share of an interval apart from even ones, and the stamps say so.
      jitter: s by which the stamps scatter though the rows do not.
    """

    suffix: str = "csv"
    separator: str = ","
    clock: str = "s"
    epoch: float = 0.0
    uneven: float = 0.0
    jitter: float = 0.0


@dataclass(frozen=True)
class Machine:
    """A machine and the bench that it was recorded on.

    Attributes:
      model: file under `models/`.
      parameters, channels, controls, signals: what the mapping file says; controls in the order of the actuators.
      motion: draws how one log is moved.
      rate: rows a second.
      seconds: of a log.
      step: physics step of the truth, s; the model's own is another.
      settle: s that the machine moves before the log begins.
      logs: how many.
    """

    model: str
    parameters: tuple[Parameter, ...]
    channels: tuple[Channel, ...]
    controls: tuple[Control, ...]
    motion: Callable[[Rng], Motion]
    rate: float
    seconds: float
    step: float = 0.0005
    settle: float = 0.0
    logs: int = 6
    signals: tuple[Signal, ...] = ()
    format: Format = field(default_factory=Format)

    def user_model(self) -> mujoco.MjModel:
        """The model as the user has it."""
        return mujoco.MjModel.from_xml_path(str(MODELS / self.model))

    def true_model(self, psi: Sequence[float]) -> mujoco.MjModel:
        """The true machine without hidden effects: with its own numbers, and at a step and integrator of its own."""
        model = self.user_model()
        model.opt.timestep = self.step
        model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
        for parameter, value in zip(self.parameters, psi, strict=True):
            parameter.write(model, value)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model


@dataclass(frozen=True)
class Case:
    """A machine with something to hide.

    Attributes:
      group: `null`, `single`, `pair` or `outside` (the library).
      hide: draws what is hidden; None hides nothing.
      what: what that is in words; the sizes come before it.
      sizes: least and greatest size that would be realistic, in the unit that `hide` takes and `what` begins with.
      shown: range, log-uniform, of how many of its noise deviations the plainest channel is off 0.2 s ahead.
      cost: rough seconds of its loop on one core: the longest begin first.
    """

    name: str
    machine: Machine
    group: str
    hide: Hide | None = None
    what: str = "nothing"
    sizes: tuple[float, float] = (1.0, 1.0)
    shown: tuple[float, float] = (10.0, 100.0)
    cost: float = 120.0


def waves(
    rng: Rng, sizes: float | Sequence[float], low: float, high: float, count: int = 6
) -> Callable[[float], Array]:
    """A smooth random course (n,) in time: sines of random phase, of `low` to `high` Hz, about as large as `sizes`."""
    scale = np.atleast_1d(np.asarray(sizes, float))
    frequency = rng.uniform(low, high, (count, len(scale)))
    phase = rng.uniform(0, 2 * np.pi, (count, len(scale)))
    height = rng.normal(0, 1, (count, len(scale))) / np.sqrt(count) * scale
    return lambda t: (height * np.sin(2 * np.pi * frequency * t + phase)).sum(0)


def between(rng: Rng, low: float, high: float) -> float:
    """Uniform between two numbers."""
    return float(rng.uniform(low, high))


def either_way(rng: Rng, low: float, high: float) -> float:
    """Uniform between two numbers, of either sign."""
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))


def log_between(rng: Rng, low: float, high: float) -> float:
    """Log-uniform between two numbers."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
