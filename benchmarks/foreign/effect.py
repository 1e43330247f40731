"""What a machine does that its model does not say: the base of all hidden effects."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rng = np.random.Generator
Signals = Mapping[str, Callable[[float], float]]  # what else is measured, by name, as functions of the log's time


@dataclass(frozen=True)
class Form:
    """A way to name an effect rightly: family, places, and the parameters that it then has (by a report's names)."""

    family: str
    where: tuple[str, ...]
    parameters: Mapping[str, float] = field(default_factory=dict)


class Effect:
    """One hidden effect; the base class hides nothing.

    Attributes:
      forms: how it may be named; the first is its own, the others are the same thing by another law. Empty for what
        the library has no law of.
      places: names of the joints and bodies at which it acts: where the rest must be said to be if it is not named.
      text: what is hidden, in words with units.
    """

    def __init__(self, forms: Sequence[Form], places: Sequence[str], text: str) -> None:
        self.forms, self.places, self.text = tuple(forms), tuple(places), text

    def build(self, model: mujoco.MjModel) -> None:
        """Change the compiled machine, once."""

    def begin(self, model: mujoco.MjModel, signals: Signals) -> None:
        """Get ready for a log from its start."""

    def command(self, u: Array, data: mujoco.MjData, t: float) -> Array:
        """What the actuators receive in this step of what was commanded, (nu,), t seconds after the log's start."""
        return u

    def push(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Add forces to `qfrc_applied` and `xfrc_applied`, both zero before."""

    def read(self, channel: str, value: Array) -> Array:
        """What a sensor tells of a channel's true value (k,)."""
        return value
