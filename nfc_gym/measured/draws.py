"""Draws that lie across one another: few of them span what many independent ones would."""

import numpy as np
from numpy.typing import NDArray

from nfc_gym.physics.parameters import ParameterSpace

Array = NDArray[np.float64]
_DRAWS = 24  # starts, at most, from which the noise where bodies touch is estimated; a step's error from two in three
_NEAR, _OFF = 4, 0.05  # psi that this noise is averaged over, with the one asked for, and how far off, a share of it


def across(rng: np.random.Generator, size: int, dim: int, most: int) -> Array:
    """Draws of unit covariance, at right angles to one another (Yu et al. 2016), for each of some blocks.

    All `dim` of them carry a covariance through a linear map exactly; independent draws do so only on average.

    Args:
      size: S blocks, whose draws are independent of one another.
      dim: n of each draw.
      most: draws at most.

    Returns:
      (D, S, n): as many whole sets of n as there is room for, or `most` of one set.
    """
    sets = max(1, most // dim)
    turns = np.linalg.qr(rng.normal(size=(size, sets, dim, dim)))[0]
    return np.moveaxis(turns.reshape(size, sets * dim, dim), 1, 0)[:most] * np.sqrt(dim)


def starts_off(sd: Array) -> tuple[Array, int]:
    """Draws (D, S, n) of the starts' noise where bodies touch, and how many of them tell a step's error.

    Draws at right angles carry the linear part of the noise as exactly as a difference for each coordinate would.

    Args:
      sd: (S, n) standard deviations.
    """
    noisy = (sd > 0).any(0)
    draws = np.zeros((1, *sd.shape))
    if noisy.any():
        found = across(np.random.default_rng(len(sd)), len(sd), int(noisy.sum()), _DRAWS)
        draws = np.zeros((len(found), *sd.shape))
        draws[..., noisy] = found * sd[:, noisy]
    return draws, -(-2 * len(draws) // 3)


def near_by(space: ParameterSpace, x: Array, seed: int) -> Array:
    """(r, size) parameters x (size,), and the same with psi a little off."""
    free = np.flatnonzero(space.free)
    rows = np.repeat(x[None], _NEAR, 0)
    off = np.random.default_rng(seed).normal(size=(_NEAR - 1, len(free)))
    low, high = np.minimum(space.low[free], x[free]), np.maximum(space.high[free], x[free])
    rows[1:, free] = np.clip(x[free] * (1 + _OFF * off), low, high)
    return rows
