"""What draws of delta_e say of a few places around the robot."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_CELL, _MIDDLE = 0.1, 63.5  # m a cell, and the cell, forward and to the left, that the robot stands on
_LEVELS = (0.05, 0.5, 0.95)
# m forward and m to the left
PLACES = {
    "1 m ahead": (1.0, 0.0), "2 m ahead": (2.0, 0.0), "4 m ahead": (4.0, 0.0), "1 m to the left": (0.0, 1.0),
    "1 m to the right": (0.0, -1.0), "1 m behind": (-1.0, 0.0),
}  # fmt: skip


class Height(NamedTuple):
    """How much higher the ground is than perceived at a place: median and 90 % interval, m."""

    place: str
    median: float
    low: float
    high: float


def heights(maps: NDArray[np.float64]) -> list[Height]:
    """Of draws of delta_e (n, 128, 128) in m, at `PLACES`: the mean of the four cells around each."""
    out = []
    for place, (forward, left) in PLACES.items():
        i, j = (int(_MIDDLE + each / _CELL) for each in (forward, left))
        low, median, high = np.quantile(maps[:, i : i + 2, j : j + 2].mean((1, 2)), _LEVELS, method="weibull").tolist()
        out.append(Height(place, median, low, high))
    return out
