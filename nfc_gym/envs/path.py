"""Paths to follow: points that move as a function of a clock."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def figure_eight(lap: Array, size: float, x: Array, y: Array, heading: Array) -> tuple[Array, Array]:
    """A point on the lemniscate of Gerono, whose crossing lies at (x, y) and whose length runs along `heading`.

    Args:
      lap: (...) laps since the start; 0 is the crossing.
      size: half the length [m]; the width is as much again.
      x, y, heading: (...) where it lies [m, m, rad].

    Returns:
      World x and y, (...) each [m].
    """
    phase = 2 * np.pi * lap
    along, across = size * np.sin(phase), size * np.sin(phase) * np.cos(phase)
    cos, sin = np.cos(heading), np.sin(heading)
    return x + cos * along - sin * across, y + sin * along + cos * across
