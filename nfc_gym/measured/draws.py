"""Draws that lie across one another: few of them span what many independent ones would."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
