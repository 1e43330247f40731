"""What a model is asked to explain: residuals of S blocks with m numbers each, and the noise to be expected in them.

Three kinds share one face: roll-outs from measured starts (`shooting`), actuator forces that a measured motion needs,
and sensors at measured states and commands (`instant`). The search above them never asks which it has.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Columns:
    """What the m numbers of a block are: report group, unit, seconds after the start, place in the model, channel."""

    group: tuple[str, ...]
    unit: tuple[str, ...]
    horizon: Array
    place: tuple[str, ...]
    channel: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.group)


class Problem(ABC):
    """Measured blocks against predictions.

    Attributes:
      columns: the meaning of the m numbers.
      mask: (S, m) where a number is compared.
      log_of: (S,) index of the log each block is from; blocks of a log are in order of time.
      names: names of the logs.
      time_of: (S,) seconds into its log at which each block starts.
      rough: whether residuals are rough functions of the parameters, as they are where bodies touch.
      costly: whether a residual costs so much that a search looks about before it refits: roll-outs of robots.
    """

    columns: Columns
    mask: NDArray[np.bool_]
    log_of: NDArray[np.intp]
    names: tuple[str, ...]
    time_of: Array
    rough = False
    costly = False

    def __len__(self) -> int:
        return len(self.log_of)

    @abstractmethod
    def residual(self, plant: Plant, x: Array) -> Array:
        """measured - predicted (P, S, m) for parameter vectors x (P, size); 0 where masked, NaN where unstable."""

    def each(self, plant: Plant, x: Array) -> Array:
        """(S, m) the same, of each block under parameters of its own: x (S, size), of which many are alike."""
        rows, of = np.unique(x, axis=0, return_inverse=True)
        return self.residual(plant, rows)[of.reshape(-1), np.arange(len(self))]

    @abstractmethod
    def covariance(self, plant: Plant, x: Array) -> Array:
        """(S, m, m) of the residual that a perfect model would leave at x (size,)."""

    @abstractmethod
    def take(self, index: NDArray[np.intp]) -> "Problem":
        """The problem of some of the blocks."""

    def part(self, index: NDArray[np.intp]) -> "Problem":
        """The same, for who asks both it and the whole: what one of them knows the other need not work out."""
        return self.take(index)

    @abstractmethod
    def synthetic(self, plant: Plant, x: Array, rng: np.random.Generator) -> "Problem":
        """The same experiment as if the model at x (size,) were the machine: fresh noise, no unknown effect."""
