"""What shorter physics steps say: claims that do not outlive half of it, and how far parameters are off for the step.

A model at a coarse step is off in the same way in every segment, and a small effect may make up for that: the noise of
the discretisation, taken segment by segment, is no bound for what adds up over all of them. What a machine really does
gains as much at half the step; what stands in for the error of a first-order step loses three quarters of its gain.
"""

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.arena import Arena
from nfc_gym.measured.contest import losses
from nfc_gym.measured.fit import Fit, fit
from nfc_gym.measured.metric import Metric
from nfc_gym.measured.owned import Data
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.steps import finer
from nfc_gym.physics.effects.base import Effect

Array = NDArray[np.float64]
_KEPT = 0.35  # share of its gain that an effect must keep at half the step
_ROUNDS = 8  # iterations of the fits at shorter steps, which reuse the slopes of the whole one
_HALVINGS = 2  # of the step, that tell how far parameters are off for it


def artefacts(arena: Arena, worth: float) -> list[Effect]:
    """Effects of an arena's model to beat that are not worth naming at half the step, the least first.

    Args:
      worth: share of the misfit that an effect must explain to be named.

    Returns:
      None of them for problems that are no roll-outs: these have no step.
    """
    fine = [_halved(d) for d in (arena.fit_data, arena.select)]
    effects = arena.current.plant.effects
    if fine[0] is None or fine[1] is None or not effects:
        return []
    exact = _loss(arena, _refit(fine[0], arena, arena.current), fine[1])
    found = []
    for effect in effects:
        bare = arena.without(effect)
        coarse = bare.misfit - arena.misfit
        left = _loss(arena, _refit(fine[0], arena, bare.current), fine[1])
        gain = left - exact
        if gain < max(arena.cost(len(effect.params)) + worth * left, _KEPT * coarse):
            found.append((gain, effect))
    return [e for _, e in sorted(found, key=lambda pair: pair[0])]


def step_error(problem: Problem, under: Metric, fitted: Fit) -> Array:
    """(2, size) how far below and above a fit's parameters the physics step may hide their values.

    Parameters make up for the step's error too: the best servo gain at 5 ms is not the machine's. A first-order step is
    off by twice what halving it changes, and by 4 / 3 of what quartering it changes; the bounds hold both, and 0. So
    much is no noise, which would be as likely to either side. Halving alone may show nothing, or the wrong side: the
    lag of a legged robot, 6.65 ms, came out 0.22 ms too long at 5 ms, 0.39 at 2.5 ms and 0.14 at 1.25 ms.

    Returns:
      The first row at most 0 and the second at least; both 0 where no roll-outs are made.
    """
    if not isinstance(problem, RolloutProblem):
        return np.zeros((2, len(fitted.x)))
    # All fits go on from one point with the same slopes, so that they differ by the step alone.
    ask = lambda p, plant: fit(p, under, plant, fitted.x, _ROUNDS, known=fitted.jacobian).x  # noqa: E731
    plant, left = fitted.plant, 1 - problem.reach(fitted.plant)
    whole, shifts = ask(problem, plant), [np.zeros(len(fitted.x))]
    for k in range(1, _HALVINGS + 1):
        problem, plant = problem.halved(), finer(plant)
        shifts.append((ask(problem, plant) - whole) / (1 - left**k))
    return np.stack([np.min(shifts, axis=0), np.max(shifts, axis=0)])


def _halved(data: Data) -> RolloutProblem | None:
    return data.problem.halved() if isinstance(data.problem, RolloutProblem) else None


def _refit(problem: RolloutProblem, arena: Arena, coarse: Fit) -> Fit:
    return fit(problem, arena.under, finer(coarse.plant), coarse.x, _ROUNDS, known=coarse.jacobian)


def _loss(arena: Arena, fitted: Fit, select: RolloutProblem) -> float:
    """On both sets of logs."""
    return float(fitted.losses.sum() + np.sum(losses(select, arena.on, fitted)))
