"""A robot as linear in what it may be like, around a belief: regression of what replays miss, and Bayes' rule."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError

Array = NDArray[np.float64]
QUIET = 0.02  # of the sensors' variance, at least
_NONE = 1e-3  # of a variance, which is as good as none
LOST = 1e3  # of the sensors' noise, by which a replay that came apart counts as off


@dataclass(frozen=True)
class Linear:
    """The robot as linear in z around where draws were taken: what is missed is offset - slope z.

    Attributes:
      slope: (n, k, d).
      offset: (n, k), at z = 0.
      left: (n, k) variance that the regression leaves.
      scatter: (d, d) inverse of the draws' scatter matrix.
    """

    slope: Array
    offset: Array
    left: Array
    scatter: Array

    def posterior(self, noise: Array, prior: Array) -> tuple[Array, Array]:
        """Mean and covariance of z ~ N(0, diag(prior)) given that nothing is missed, by noise (n, k, k)."""
        n, k, d = self.slope.shape
        white: Any = np.linalg.inv(np.linalg.cholesky(noise))
        slope, offset = (white @ self.slope).reshape(n * k, d), (white @ self.offset[..., None]).reshape(-1)
        unit = np.sqrt(prior)
        # The slope of k ends is off by independent errors, which would add up to a precision that is not there.
        spurious = (white**2 @ self.left[..., None]).sum()
        excess = unit[:, None] * spurious * self.scatter * unit
        mean, covariance = linear_posterior(slope * unit, offset, np.ones(n * k), excess)
        return unit * mean, unit[:, None] * covariance * unit


def regressed(z: Array, off: Array) -> Linear:
    """Of what replays under draws (m, d) miss, (m, n, k), on the draws; those that come apart are left out.

    Raises:
      InputError: too few are left.
    """
    fine = np.isfinite(off).all((1, 2))
    if fine.sum() < z.shape[1] + 4:
        raise InputError("assimilation: most replays come apart: the trajectory does not fit this robot")
    z, off = z[fine], off[fine]
    centre, (m, n, k) = z.mean(0), off.shape
    design = np.concatenate([z - centre, np.ones((m, 1))], 1)
    y = off.reshape(m, -1)
    found: Any = np.linalg.lstsq(design, y, rcond=None)[0]
    left = ((y - design @ found) ** 2).sum(0) / max(1, m - design.shape[1])
    slope = -found[:-1].T
    scatter: Any = np.linalg.inv((z - centre).T @ (z - centre))
    return Linear(slope.reshape(n, k, -1), (found[-1] + slope @ centre).reshape(n, k), left.reshape(n, k), scatter)


def as_seen(noise: Array, off: Array) -> Array:
    """Noise (n, k, k) of segments' ends, in units of the sensors', scaled entry by entry to what replays miss, (n, k).

    Of the variance of each entry 1 is the sensor's; the rest, of start, motors and map, is correlated. What is missed
    beyond the sensor's is taken for the rest, however much that was assumed to be: what nothing in the model explains
    says nothing of its parameters. Where less is missed than sensors were thought to add, sensors are better.
    """
    missed = (np.where(np.isfinite(off), off, LOST) ** 2).mean(0)
    rest = noise - np.eye(noise.shape[-1])
    sensor = np.clip(missed, QUIET, 1.0)
    assumed = np.diagonal(rest, axis1=1, axis2=2).mean(0)
    times = np.maximum(missed - sensor, 0) / np.maximum(assumed, _NONE) + _NONE
    beyond = np.maximum(missed - sensor - times * assumed, 0)  # where nothing was assumed that could be more
    share = np.sqrt(times)
    return share[:, None] * rest * share + np.diag(sensor + beyond)


def cost(z: Array, prior: Array, off: Array, noise: Array) -> Array:
    """(m,) twice the negative logarithm of prior times likelihood of z (m, d) that miss by (m, n, k)."""
    each: Any = np.linalg.solve(noise, np.where(np.isfinite(off), off, LOST)[..., None])[..., 0]
    return (z * z / prior).sum(1) + (np.where(np.isfinite(off), off, LOST) * each).sum((1, 2))


def linear_posterior(slope: Array, offset: Array, noise: Array, excess: Any = 0.0) -> tuple[Array, Array]:
    """Mean (d,) and covariance (d, d) of z ~ N(0, I) given offset = slope z + N(0, diag(noise)).

    Args:
      slope: (k, d).
      offset: (k,).
      noise: (k,) variances.
      excess: (d, d) precision that errors of the slope alone would seem to give, to be taken off; directions of which
        nothing then is left keep the prior.
    """
    weighted = slope / noise[:, None]
    precision = weighted.T @ slope
    values, vectors = np.linalg.eigh(precision - excess)
    covariance = (vectors / (1 + np.maximum(values, 0))) @ vectors.T
    mean: Any = np.linalg.solve(np.eye(len(precision)) + precision, weighted.T @ offset)
    return mean, covariance
