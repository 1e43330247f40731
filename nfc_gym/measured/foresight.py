"""How far ahead of a measured start slopes tell what psi does: where bodies touch, less far than users want to predict.

A foot that lands a step sooner changes all that follows. An ant's motion 0.4 s after its start is no function of a
leg's mass that any straight line follows: fits end in one of many hollows, hundreds apart in loss. Segments a quarter
as long, four times as many, cost the same, and their fits end within tens of each other.
"""

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.box import box
from nfc_gym.measured.fit import COARSE
from nfc_gym.measured.problem import Problem
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
BLOCKS = 48  # that are looked at
_DRAWS = 8  # directions in which psi is moved
_BENT = 0.4  # of a change: what may be bent of it for slopes to be worth following
_FEWEST = 2  # horizons that are kept


def bent(problem: Problem, plant: Plant, x: Array) -> Array:
    """(h,) for each horizon: how much of the change that a step of psi makes is not along a straight line.

    Psi is moved to both sides by as much as a coarse difference (`fit.COARSE`), in directions drawn at random. Of each
    number what the two changes have in common is divided by what they have apart; the median is 0 for a linear model,
    and about 1 where either side is as good as drawn anew.
    """
    limits = box(plant)
    z = limits.at(x)
    room = np.minimum(z - limits.floor, limits.roof - z)
    moves = np.random.default_rng(len(problem)).normal(size=(_DRAWS, len(z))) * COARSE / np.sqrt(len(z))
    moves = np.clip(moves, -room, room)
    rows = problem.residual(plant, limits.x(np.concatenate([z[None], z + moves, z - moves]), x))
    up, down = rows[1 : 1 + _DRAWS] - rows[0], rows[1 + _DRAWS :] - rows[0]
    horizon, out = problem.columns.horizon, []
    for h in np.unique(horizon):
        at = horizon == h
        same, apart = np.abs(up + down)[..., at], np.abs(up - down)[..., at]
        shows = problem.mask[:, at] & np.isfinite(same) & (apart > 0)
        out.append(float(np.median(same[shows] / apart[shows])) if shows.any() else 0.0)
    return np.array(out)


def followed(problem: Problem, plant: Plant, x: Array) -> int:
    """How many of a problem's horizons, from the shortest on, slopes can follow.

    All where nothing is rough or free, and where even the shortest is bent: then the length is not what bends it.
    """
    count = len(np.unique(problem.columns.horizon))
    if not problem.rough or not plant.space.free.any():
        return count
    lost = bent(problem, plant, x) > _BENT
    return count if lost[0] or not lost.any() else min(max(int(lost.argmax()), _FEWEST), count)
