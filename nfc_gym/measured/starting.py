"""Where the fit of screened candidates starts: parameters of their own, and the step of all else that suits them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.box import box
from nfc_gym.measured.fit import Fit
from nfc_gym.measured.metric import Metric
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.screen import Screened, answer
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]


def starts(problem: Problem, under: Metric, current: Fit, plant: Plant, picks: Sequence[Screened]) -> Array:
    """(r, n) parameter vectors of a plant that adds screened candidates to a fitted model.

    They are where screening points, the model moved as it says and left as it is; and, where a candidate knows a valley
    that its screening may have met at the wrong end, other places along that, the model moved as its slopes answer
    them. The latter takes a batch of roll-outs.
    """
    limits, here = box(current.plant), current.x
    theta = np.concatenate([s.theta for s in picks])
    moved = limits.x(limits.at(here) + picks[0].shift, here)
    pointed = np.stack([np.concatenate([x, theta]) for x in (moved, here)])
    along = _along(picks, theta)
    if not len(along):
        return pointed
    white = under.whiten(problem.residual(plant, _beside(here, along)))
    return np.concatenate([pointed, _beside(limits.x(limits.at(here) + answer(current, white), here), along)])


def _along(picks: Sequence[Screened], theta: Array) -> Array:
    """(r, k) candidates' parameters with those of one replaced by its other starts, the rest being theta (k,)."""
    rows, at = [], 0
    for s in picks:
        others = s.effect.starts(s.theta)
        rows.append(np.repeat(theta[None], len(others), 0))
        rows[-1][:, at : at + len(s.theta)] = others
        at += len(s.theta)
    return np.concatenate(rows)


def _beside(x: Array, thetas: Array) -> Array:
    """Rows of a model's parameters, (j,) or (r, j), and of what is added to it, (r, k)."""
    return np.concatenate([np.broadcast_to(x, (len(thetas), x.shape[-1])), thetas], 1)
