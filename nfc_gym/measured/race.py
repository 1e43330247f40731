"""Which of many parameter vectors leaves least: who is far behind on some of the blocks is not asked of all.

Maron and Moore (1994), Hoeffding races: most of what a wide search tries is far off, and a third of the blocks says so.
Differences are taken block by block, so that what all leave alike does not blur them.
"""

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.metric import Metric, loss
from nfc_gym.measured.problem import Problem
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
_FIRST, _FEWEST = 3, 4  # every so many blocks are asked first, where that leaves as many
_BEHIND = 3.0  # standard errors that one is behind there to be lost, and one number so many deviations off


def lost(told: Array) -> NDArray[np.bool_]:
    """(P,) which of P rivals are surely not the least, by their losses on some of the blocks (P, S)."""
    behind = told - told[told.sum(1).argmin()]
    error = np.sqrt(told.shape[1]) * behind.std(1)
    return np.asarray(behind.sum(1) > np.maximum(_BEHIND * error, _BEHIND**2))


class Race:
    """Parameter vectors compared on the blocks of a problem.

    Args:
      problem: the blocks.
      metric: of them.
    """

    def __init__(self, problem: Problem, metric: Metric) -> None:
        every = np.arange(len(problem))
        first = every % _FIRST == 0 if len(every) >= _FIRST * _FEWEST else every >= 0
        self._parts = [(problem.part(i), metric.take(i)) for i in (every[first], every[~first]) if len(i)]

    def losses(self, plant: Plant, x: Array) -> Array:
        """(P,) losses of parameter vectors x (P, size) over all blocks; infinite for those lost on the way."""
        told = self._told(0, plant, x)
        if len(self._parts) == 1:
            return told.sum(1)
        running = np.flatnonzero(~lost(told))
        out = np.full(len(x), np.inf)
        out[running] = told[running].sum(1) + self._told(1, plant, x[running]).sum(1)
        return out

    def _told(self, part: int, plant: Plant, x: Array) -> Array:
        problem, metric = self._parts[part]
        return loss(metric.whiten(problem.residual(plant, x)))
