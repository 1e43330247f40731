"""First-order lags along a whole course at once."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FORGOTTEN = 8.0  # time constants after which a state shows no more of where it began
_NONE = 1e-18  # of a gap: what is left of it adds nothing to a number


def chased(wish: Array, keep: Array, start: Array) -> Array:
    """y_t = wish_t + keep (y_(t-1) - wish_t) for all t, to rounding what walking gives, and exactly where wish rests.

    The gaps y - wish follow a linear recurrence, whose sums over 2^k steps are made of two over 2^(k-1).

    Args:
      wish: (..., T, n).
      keep: (..., n) in [0, 1], what a step leaves of a gap.
      start: (..., n) y before the first step.
    """
    behind = keep[..., None, :] * -np.diff(wish, axis=-2, prepend=start[..., None, :])
    left, steps = keep, 1
    while steps < wish.shape[-2] and (left > _NONE).any():
        behind[..., steps:, :] += left[..., None, :] * behind[..., :-steps, :]
        left, steps = left * left, 2 * steps
    return wish + behind
