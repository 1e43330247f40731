"""Pillars and towers for flying robots: a level floor with obstacles that an elevation map sees from above."""

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.terrain.kinds import Grid

Array = NDArray[np.float64]

# At difficulty 1. Floor to ceiling of a hall is 4 m; a quadcopter of the 1 kg class spans 0.55 m over its propellers.
DENSITY = 0.16  # obstacles a square metre, tried; `CLEARANCE` turns some away
HEIGHTS = (0.6, 4.0)  # m
RADII = (0.15, 0.6)  # m; half the side of a tower
CLEARANCE = 1.2  # m between any two obstacles: twice the span, so that every free place can be reached


def towers(
    rng: np.random.Generator,
    grid: Grid,
    difficulty: float,
    goal: tuple[float, float] | None = None,
    corridor: float = 0.0,
) -> Array:
    """Round pillars and square, turned towers of various heights.

    Any two are `CLEARANCE` apart, so the free space is connected at flying height for a robot that fits between them.
    A higher difficulty keeps the obstacles of a lower one and adds more.

    Args:
      rng: draws the obstacles, in an order that does not depend on the difficulty.
      grid: where; no obstacle reaches into its spawn patch.
      difficulty: 0 is the empty floor.
      goal: x and y from the map's middle [m]; a disc of the spawn patch's radius around it stays free.
      corridor: width [m] of a straight passage from the middle to the goal that stays free; 0 is none.

    Returns:
      (nrow, ncol) heights [m].
    """
    if corridor and goal is None:
        raise InputError(f"corridor {corridor!r}: needs a goal to lead to")
    x, y = grid.xy
    half = np.array([x.max(), y.max()])
    tries = round(DENSITY * 4 * half[0] * half[1])
    centres = rng.uniform(-half, half, (tries, 2))
    radii = rng.uniform(*RADII, tries)
    tops = rng.uniform(*HEIGHTS, tries)
    turns = rng.uniform(0, np.pi / 2, tries)
    round_ones = rng.random(tries) < 0.5
    reach = np.where(round_ones, radii, np.sqrt(2) * radii)
    free = np.linalg.norm(centres, axis=1) - reach > grid.spawn
    if goal is not None:
        free &= np.linalg.norm(centres - goal, axis=1) - reach > grid.spawn
        free &= _from_segment(centres, np.array(goal)) - reach > corridor / 2 if corridor else True
    kept: list[int] = []
    for k in np.flatnonzero(free):
        apart = np.linalg.norm(centres[kept] - centres[k], axis=1) - reach[kept] - reach[k]
        if (apart > CLEARANCE).all():
            kept.append(int(k))
    heights = np.zeros(grid.shape)
    for k in kept[: round(difficulty * len(kept))]:
        across = slice(*np.searchsorted(x[0], centres[k, 0] + reach[k] * np.array([-1, 1])))
        along = slice(*np.searchsorted(y[:, 0], centres[k, 1] + reach[k] * np.array([-1, 1])))
        east, north = x[:, across] - centres[k, 0], y[along] - centres[k, 1]
        if round_ones[k]:
            inside = np.hypot(east, north) <= radii[k]
        else:
            cos, sin = np.cos(turns[k]), np.sin(turns[k])
            inside = np.maximum(np.abs(cos * east + sin * north), np.abs(cos * north - sin * east)) <= radii[k]
        heights[along, across][inside] = grid.scale * tops[k]
    return heights


def _from_segment(points: Array, end: Array) -> Array:
    """Distance of points (n, 2) from the straight line between the origin and `end`."""
    along = np.clip(points @ end / max(end @ end, 1e-12), 0.0, 1.0)
    return np.linalg.norm(points - along[:, None] * end, axis=1)
