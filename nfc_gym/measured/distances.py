"""How far apart rival explanations of data lie, in sigma, once everything in the rival is refitted.

Atkinson and Fedorov (1975), Biometrika 62, 57, compare models so (T-optimality). The rival's parameters and psi are
refitted in the linear approximation around its fit to the present logs: what they can imitate is projected out
(`fisher`). Columns of present and of new data add up, since their inner products do.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.box import box
from nfc_gym.measured.fisher import Lens, left_over
from nfc_gym.measured.metric import Metric
from nfc_gym.measured.problem import Problem
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Model:
    """A plant and its parameters (size,)."""

    plant: Plant
    x: Array


@dataclass(frozen=True)
class Ask:
    """One question: if `truth` were the machine, how far off would `rival` stay with everything in it refitted?

    Attributes:
      needed: distance at which the answer is sure, sigma.
    """

    truth: Model
    rival: Model
    needed: float


class Distances:
    """Questions, and what the present logs answer.

    Args:
      asks: the questions.
      present: the logs at hand, seen from the fitted model.
      repeats: how many times the blocks looked at there are the logs' own blocks.

    Attributes:
      before: (asks,) distances in the present logs, sigma.
    """

    def __init__(self, asks: Sequence[Ask], present: Lens, repeats: float) -> None:
        self.asks = list(asks)
        self.root: Array = np.asarray(
            np.linalg.inv(np.median(np.linalg.inv(present.under.inverse_root), 0)), np.float64
        )
        self.rivals = list({id(a.rival): a.rival for a in asks}.values())
        grams = [self._grams(present.problem, present.under, rival, present.weight) for rival in self.rivals]
        self.known = [repeats * g.sum(0) for g in grams]
        self.before = self._answers([k[None] for k in self.known])[0]

    def after(self, problem: Problem, sequence: NDArray[np.intp]) -> Array:
        """(N, asks) distances in the present logs and one of N new recordings, whose number each block (S,) has.

        New data are whitened like the present ones on the whole: what a motion costs in noise is not known before.
        """
        under = Metric(np.broadcast_to(self.root, (len(problem), *self.root.shape)), problem.mask)
        grams = []
        for rival, known in zip(self.rivals, self.known, strict=True):
            gram = np.repeat(known[None], int(sequence.max()) + 1, 0)
            np.add.at(gram, sequence, self._grams(problem, under, rival, np.ones(problem.mask.shape)))
            grams.append(gram)
        return self._answers(grams)

    def _of(self, rival: Model) -> list[int]:
        return [j for j, a in enumerate(self.asks) if a.rival is rival]

    def _grams(self, problem: Problem, under: Metric, rival: Model, weight: Array) -> Array:
        """(S, c, c) inner products of a rival's tangent and of the ways from it to the truths, block by block."""
        lens = Lens(problem, under, rival.plant, rival.x, weight)
        ways = [lens.moved(self.asks[j].truth.plant, self.asks[j].truth.x[None]) for j in self._of(rival)]
        columns = np.concatenate([lens.tangent, *ways], -1)
        return np.swapaxes(columns, 1, 2) @ columns

    def _answers(self, grams: Sequence[Array]) -> Array:
        """(N, asks) distances, from grams (N, c, c) of each rival."""
        out = np.zeros((len(grams[0]), len(self.asks)))
        for rival, of in zip(self.rivals, grams, strict=True):
            pull = box(rival.plant).pull
            own = range(len(pull))
            for i, gram in enumerate(of):
                bounded = gram.copy()
                bounded[own, own] += pull**2
                for at, j in enumerate(self._of(rival), len(pull)):
                    out[i, j] = np.sqrt(left_over(bounded, at, own))
        return out
