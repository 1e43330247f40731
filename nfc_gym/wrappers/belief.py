"""A posterior as a Gaussian in unbounded coordinates, from its samples: mean + beta L h, h in [-1, 1]."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from nfc_gym.core.errors import InputError
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.physics.parameters import ParameterSpace

Array = NDArray[np.float64]
_EDGE = 1e-6  # how near to its box's bounds psi may come, as a share of the box


class Belief:
    """The mean of a posterior and the directions in which it is uncertain.

    Coordinates are psi by its probit in the prior's box (widened where samples lie outside), the leading principal
    modes of delta_e, and delta_s, jointly and in this order; L is the lower Cholesky factor of their covariance, so
    that what holds for an episode comes first and does not depend on what varies with each step.

    Args:
      samples: (n,) of the posterior.
      space: psi's, where the samples hold psi.
      modes: how many modes of delta_e at most, one or more where the samples hold it.

    Attributes:
      size: of h: psi's, then the modes', then delta_s's entries.
      held: how many of them hold for an episode.

    Raises:
      InputError: fewer than two samples, or psi of another size than the space.
    """

    def __init__(self, samples: Fidelity, space: ParameterSpace | None, modes: int) -> None:
        if not samples.given or not samples.batched or len(samples) < 2:
            raise InputError("Hallucinate: the posterior must give two samples or more of psi, delta_s or delta_e")
        parts: list[Array] = []
        self.psi_size = self.mode_count = self.step_size = 0
        if samples.psi is not None and space is not None:
            if samples.psi.shape[1] != len(space):
                raise InputError(
                    f"Hallucinate: the posterior's psi has {samples.psi.shape[1]} entries; want "
                    + ", ".join(space.names)
                )
            self.low = np.minimum(space.low, samples.psi.min(0))
            self.high = np.maximum(space.high, samples.psi.max(0))
            share = (samples.psi - self.low) / (self.high - self.low)
            parts.append(ndtri(np.clip(share, _EDGE, 1 - _EDGE)))
            self.psi_size = len(space)
        if samples.delta_e is not None:
            parts.append(self._principal(samples.delta_e, modes))
            self.mode_count = parts[-1].shape[1]
        if samples.delta_s is not None:
            parts.append(samples.delta_s)
            self.step_size = samples.delta_s.shape[1]
        joint = np.concatenate(parts, 1)
        self.mean = joint.mean(0)
        self.root = _cholesky(np.atleast_2d(np.cov(joint, rowvar=False)))
        self.size, self.held = joint.shape[1], self.psi_size + self.mode_count

    def _principal(self, maps: Array, modes: int) -> Array:
        """(n, k) scores of maps (n, rows, columns) on their leading modes."""
        if modes < 1:
            raise InputError(f"Hallucinate: modes of delta_e must be 1 or more, got {modes}")
        self.shape = maps.shape[1:]
        flat = maps.reshape(len(maps), -1)
        self.middle = flat.mean(0)
        # The eigenvectors of the samples' Gram matrix, n x n, are the left singular vectors; maps have 65536 cells.
        spread = flat - self.middle
        squared, left = np.linalg.eigh(spread @ spread.T)
        values = np.sqrt(np.maximum(squared[::-1], 0))
        keep = min(modes, max(1, int((values > 1e-6 * max(values[0], 1e-300)).sum())))
        scale, left = values[:keep], left[:, ::-1][:, :keep]
        self.modes = left.T @ spread / np.where(scale > 0, scale, 1)[:, None]
        return left * scale

    def __repr__(self) -> str:
        parts = {"psi": self.psi_size, "modes": self.mode_count, "delta_s": self.step_size}
        sizes = ", ".join(f"{name} {size}" for name, size in parts.items() if size)
        return f"Belief({sizes}; held {self.held} of {self.size})"

    def held_part(self, h: Array, beta: float) -> Array:
        """What the held entries of h (..., held) alone make of delta_s, (..., s): see `lever`."""
        h = np.minimum(np.maximum(h, -1.0), 1.0)
        return self.mean[self.held :] + beta * (self.root[self.held :, : self.held] * h[..., None, :]).sum(-1)

    def lever(self, beta: float) -> Array:
        """(s, s): with the other entries of h, `held_part` + `lever` h is the delta_s of `at`, at a step's price."""
        return np.ascontiguousarray(beta * self.root[self.held :, self.held :])

    def at(self, h: Array, beta: float) -> Fidelity:
        """The fidelity at mean + beta L h, h (..., size) clipped to [-1, 1]."""
        h = np.minimum(np.maximum(h, -1.0), 1.0)
        z = self.mean + beta * (self.root * h[..., None, :]).sum(-1)
        psi = delta_s = delta_e = None
        if self.psi_size:
            psi = self.low + (self.high - self.low) * ndtr(z[..., : self.psi_size])
        if self.mode_count:
            delta_e = (self.middle + z[..., self.psi_size : self.held] @ self.modes).reshape(*h.shape[:-1], *self.shape)
        if self.step_size:
            delta_s = z[..., self.held :]
        return Fidelity(psi, delta_s, delta_e)


def _cholesky(covariance: Array) -> Array:
    """Lower factor of a covariance that may be singular: entries that do not vary have rows of zeros."""
    sd = np.sqrt(np.diag(covariance))
    varies = sd > 0
    out = np.zeros_like(covariance)
    if varies.any():
        scale = sd[varies]
        correlation = covariance[np.ix_(varies, varies)] / np.outer(scale, scale)
        # Fewer samples than entries make it singular; a millionth of independent variance does no harm.
        factor = np.linalg.cholesky(correlation + 1e-6 * np.eye(len(scale))) / np.sqrt(1 + 1e-6)
        out[np.ix_(varies, varies)] = scale[:, None] * factor
    return out
