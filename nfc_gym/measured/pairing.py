"""Which two laws to try together: those that straight lines say go together best.

The leading candidates of a round are often one thing under several names, a rotor that pushes less, a command that is
off, a centre of mass that is shifted; two of these together gain no more than one. What is at work beside the leader
may have gained little alone.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from nfc_gym.measured.arena import Arena
from nfc_gym.measured.contest import Judged, fitted_residual
from nfc_gym.measured.screen import Screen
from nfc_gym.measured.yardstick import HOPE

Array = NDArray[np.float64]


def promising(arena: Arena, pool: Sequence[Judged], most: int) -> list[tuple[Judged, Judged]]:
    """The pairs of fitted candidates of different families that promise most together, best first.

    A pair that promises next to nothing of what the second law would have to gain is none.

    Args:
      arena: whose model to beat they would join.
      pool: candidates, each fitted beside that model.
      most: pairs.
    """
    pairs = [
        (i, k)
        for i, k in combinations(range(len(pool)), 2)
        if arena.new(pool[i])[0].family != arena.new(pool[k])[0].family
    ]
    if not pairs:
        return []
    screen = Screen(arena.fit_data.problem, arena.under, arena.current)
    change = _changes(screen, pool)
    numbers = [sum(len(e.params) for e in arena.new(j)) for j in pool]

    def left(*of: int) -> float:
        """Loss beside some candidates. A fit may go beyond what it did alone, or not so far; it does not turn back."""
        return float(nnls(change[:, of], -screen.projected)[1]) ** 2

    alone, both = [left(i) for i in range(len(pool))], {pair: left(*pair) for pair in pairs}

    def hopeful(pair: tuple[int, int]) -> bool:
        better, other = sorted(pair, key=alone.__getitem__)
        return arena.on_both(alone[better] - both[pair]) > HOPE * arena.cost(numbers[other])

    return [(pool[i], pool[k]) for i, k in sorted(filter(hopeful, pairs), key=both.__getitem__)[:most]]


def _changes(screen: Screen, pool: Sequence[Judged]) -> Array:
    """(n, k) what each candidate changes of the weighted residual that psi and the laws at work could not."""
    white = [screen.metric.whiten(fitted_residual(screen.problem, j.fitted))[0] for j in pool]
    return screen.project(np.stack([(screen.weight * (w - screen.current.white)).ravel() for w in white], 1))
