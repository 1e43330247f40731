"""Which of many parameter vectors leaves least: who is far behind on some of the blocks is not asked of all.

Maron and Moore (1994), Hoeffding races: most of what a wide search tries is far off, and a third of the blocks says so,
or two.
Differences are taken block by block, so that what all leave alike does not blur them.
"""

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.metric import Metric, loss
from nfc_gym.measured.problem import Problem
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
_PARTS, _FEWEST = 3, 4  # that blocks are asked in, where each has as many
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
        every, parts = np.arange(len(problem)), _PARTS if len(problem) >= _PARTS * _FEWEST else 1
        split = [every[k::parts] for k in range(parts)]
        self._parts = [(problem.part(i), metric.take(i)) for i in split] if parts > 1 else [(problem, metric)]

    def losses(self, plant: Plant, x: Array) -> Array:
        """(P,) losses of parameter vectors x (P, size) over all blocks; infinite for those lost on the way."""
        return self._run(plant, x)[0]

    def ranked(self, plant: Plant, x: Array) -> tuple[Array, Array]:
        """(P,) the same, and what to rank by: those lost have what the blocks they were asked of make likely."""
        losses, likely = self._run(plant, x)
        return losses, np.where(np.isinf(losses), np.maximum(likely, losses.min()), losses)

    def _run(self, plant: Plant, x: Array) -> tuple[Array, Array]:
        """(P,) losses, infinite for those lost; (P,) what the blocks that each was asked of say of all."""
        running, told = np.arange(len(x)), np.zeros((len(x), 0))
        losses, likely = np.full(len(x), np.inf), np.zeros(len(x))
        for k in range(len(self._parts)):
            told = np.concatenate([told, self._told(k, plant, x[running])], 1)
            likely[running] = told.mean(1) * sum(len(p) for p, _ in self._parts)
            if k < len(self._parts) - 1:
                left = ~lost(told)
                running, told = running[left], told[left]
        losses[running] = told.sum(1)
        return losses, likely

    def _told(self, part: int, plant: Plant, x: Array) -> Array:
        problem, metric = self._parts[part]
        return loss(metric.whiten(problem.residual(plant, x)))
