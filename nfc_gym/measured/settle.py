"""Fit and metric in turns: what a better model explains must not go on as slack in the metric that judges it."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.fit import Fit, fit, fitted, polish
from nfc_gym.measured.metric import Metric, metric, unexplained_variance
from nfc_gym.measured.problem import Problem
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
TURNS = 4  # refreshments of the metric, at most
_STEADY = 0.05  # relative change of standard deviations below which a metric has settled
_EVALUATIONS = 80  # of the polish without derivatives that the first turn of a rough problem ends with


def slack(problem: Problem, sigma: Array, plant: Plant, x: Array) -> Array:
    """(m,) variance that a model leaves unexplained in each kind of column."""
    return unexplained_variance(problem, problem.residual(plant, x[None])[0], sigma)


def settle(
    problem: Problem,
    sigma: Array,
    plant: Plant,
    x: Array,
    seed: int | None = None,
    rounds: int = 12,
    tick: Callable[[int], None] = lambda turn: None,
) -> tuple[Fit, Metric, Array]:
    """Refit every parameter and refresh the metric in turns until it hardly changes.

    Args:
      sigma: (S, m, m) covariance of the noise.
      x: (size,) where to start.
      seed: of the polish that rough problems get; None for a start that needs none.
      rounds: iterations of each refit, at most.
      tick: called with the number of each turn, from 1.

    Returns:
      The fit, the metric it was fitted under, and that metric's slack (m,).
    """
    noise = np.einsum("sii->i", sigma) / max(len(problem), 1)
    extra = slack(problem, sigma, plant, x)
    for turn in range(1, TURNS + 1):
        tick(turn)
        under = metric(problem, sigma, extra)
        # Later turns start where the first one ended.
        x = fitted(problem, under, plant, x, rounds if turn == 1 else rounds // 2)
        if problem.rough and seed is not None and turn == 1:
            x = polish(problem, under, plant, x, _EVALUATIONS, seed)
        before, extra = extra, slack(problem, sigma, plant, x)
        if np.allclose(np.sqrt(extra + noise), np.sqrt(before + noise), rtol=_STEADY):
            break
    under = metric(problem, sigma, extra)
    return fit(problem, under, plant, x, rounds // 3), under, extra
