"""What `Assimilation` believes: psi, delta_s, and the sizes of effects that the model lacks."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from nfc_gym.adaptation.structure import Structure, kept
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.physics.effects import Effect

Array = NDArray[np.float64]
_PRESENT = 0.1  # of an effect's scale, below which it is left out of the worlds that a belief stands for
_EDGE = 1e-4  # how near to its box's bounds psi is drawn, as a share of the box


@dataclass(frozen=True)
class Box:
    """Bounds of psi, and its coordinates z in which the prior is standard normal.

    Attributes:
      low, high: (d,) physical units.
    """

    low: Array
    high: Array

    def psi(self, z: Array) -> Array:
        """(..., d) in physical units."""
        return self.low + (self.high - self.low) * np.clip(ndtr(z), _EDGE, 1 - _EDGE)

    def z(self, psi: Array) -> Array:
        """Its inverse."""
        return ndtri(np.clip((psi - self.low) / (self.high - self.low), _EDGE, 1 - _EDGE))


@dataclass(frozen=True)
class Assimilated:
    """A belief about psi, delta_s, and the sizes of effects that the model lacks.

    Attributes:
      box: psi's.
      mean, covariance: of z, (d + k,) and (d + k, d + k): psi's coordinates, then those of the structure.
      delta: (s,) mean of delta_s, a control step; None says nothing of it.
      spread: (s,) standard deviation of that mean.
      structure: of k sizes.
      noise: (s,) standard deviation of `proprio` as it is sensed; None says nothing of it.
      share: of the covariance, within which draws replay what was seen about as well as the mean does.
    """

    box: Box
    mean: Array
    covariance: Array
    delta: Array | None = None
    spread: Array | None = None
    structure: Structure = field(default_factory=Structure)
    noise: Array | None = None
    share: float = 1.0

    def near(self) -> "Assimilated":
        """As wide only as draws still do what was seen.

        What is believed is a bent valley, and its covariance the box around it: a draw from that box, whose psi and
        effects moreover are drawn apart, is as a rule a robot that nothing of the trajectory speaks for.
        """
        d = len(self.box.low)
        apart = self.covariance.copy()
        apart[:d, d:] = apart[d:, :d] = 0
        return replace(self, covariance=self.share * apart, share=1.0)

    def coordinates(self, n: int, rng: np.random.Generator) -> Array:
        """(n, d + k) draws of z."""
        return rng.multivariate_normal(self.mean, self.covariance, n, method="cholesky")

    def effects(self, n: int, rng: np.random.Generator) -> list[tuple[Effect, Array]]:
        """Effects at work and their sizes (n, k) in n worlds; what is as good as absent is left out."""
        z = self.coordinates(n, rng)
        found = kept(self.structure, self.structure.values(z[:, len(self.box.low) :]), _PRESENT)
        return [(self.structure.effects[i], theta) for i, theta in found.items()]

    def sample(self, n: int, rng: np.random.Generator) -> Fidelity:
        """See `Sampler`."""
        z = self.coordinates(n, rng)
        psi = self.box.psi(z[:, : len(self.box.low)])
        if self.delta is None or self.spread is None:
            return Fidelity(psi)
        return Fidelity(psi, self.delta + self.spread * rng.standard_normal((n, len(self.delta))))
