"""Claims that do not outlive half the physics step.

A model at a coarse step is off in the same way in every segment, and a small effect may make up for that: the noise of
the discretisation, taken segment by segment, is no bound for what adds up over all of them. What a machine really does
gains as much at half the step; what stands in for the error of a first-order step loses three quarters of its gain.
"""

import numpy as np

from nfc_gym.measured.arena import Arena, Data
from nfc_gym.measured.contest import losses
from nfc_gym.measured.fit import Fit, fit
from nfc_gym.measured.shooting import RolloutProblem, finer
from nfc_gym.physics.effects.base import Effect

_KEPT = 0.35  # share of its gain that an effect must keep at half the step
_ROUNDS = 8  # iterations of the fits at half the step, which reuse the slopes of the whole one


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


def _halved(data: Data) -> RolloutProblem | None:
    return data.problem.halved() if isinstance(data.problem, RolloutProblem) else None


def _refit(problem: RolloutProblem, arena: Arena, coarse: Fit) -> Fit:
    return fit(problem, arena.under, finer(coarse.plant), coarse.x, _ROUNDS, known=coarse.jacobian)


def _loss(arena: Arena, fitted: Fit, select: RolloutProblem) -> float:
    """On both sets of logs."""
    return float(fitted.losses.sum() + np.sum(losses(select, arena.on, fitted)))
