"""Where bodies touch: a fit over starts drawn from their noise, in which what jumps cancels and what slopes adds up.

A foot that lands a step sooner throws every number of a segment off. Least squares on one set of starts count the
squares of such jumps as curvature: of an Ant's masses, along the valley in which its legs trade them, a hundred times
what is there. Its steps are then a hundred times too short, it ends wherever it began, and standard deviations are ten
times too small. The product of a slope at one start and the slope at another, drawn apart, has what both share and no
jumps: from such products come the Hessian and the gradient here (in spirit the cross-fitting of Chernozhukov et al.
2018).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.box import Box, box
from nfc_gym.measured.contest import clusters
from nfc_gym.measured.elsewhere import Ended
from nfc_gym.measured.fit import Fit, jacobian
from nfc_gym.measured.metric import Metric, loss, loss_weight
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.shooting import RolloutProblem

Array = NDArray[np.float64]
TURNS, _KEPT = 8, 4  # steps, each over starts of its own; of which the last are averaged
_DRAWS = 3  # sets of starts of a turn
_STEP = 0.3  # of differences, in scaled parameters: wide, lest jumps outweigh slopes
_FAR = 0.5  # that a turn moves a scaled parameter at most
_DAMPING = 0.03  # of a Hessian scaled to a unit diagonal: directions that are flatter are hardly gone along
_FLAT = 1e-3  # of it: curvature that is not told from none
_PARTS = np.array([0.0, 1.0, 0.5, 0.2])  # of a step that are tried


@dataclass(frozen=True)
class _Turn:
    """What draws of starts at one place tell, from products of what is seen at different ones of them.

    Attributes:
      hessian: (f, f) by slopes and slopes.
      scores: (S, f) by slopes and residuals, of each block; their sum is the gradient.
    """

    hessian: Array
    scores: Array


def marginal(
    problem: Problem, under: Metric, found: Fit, seed: int, tick: Callable[[int], None] = lambda turn: None
) -> Ended:
    """Go on from a fit by Gauss-Newton steps over drawn starts.

    Args:
      problem: roll-outs; any other is as the fit at hand has it.
      under: metric to fit under.
      found: the fit at hand.
      seed: of the starts.
      tick: called with the number of each turn, from 1.

    Returns:
      The mean of the last turns; as `unsure` the standard deviations by these products, with what the turns differ by.
    """
    limits = box(found.plant)
    if not isinstance(problem, RolloutProblem) or not len(limits.scale):
        return Ended(found.x, np.zeros(len(found.x)))
    z, last, places = limits.at(found.x), [], []
    for number in range(TURNS):
        tick(number + 1)
        drawn = [problem.redrawn(np.random.default_rng([seed, number, k])) for k in range(_DRAWS)]
        turn = _looked(drawn, under, limits, limits.x(z, found.x))
        last = [*last[1 - _KEPT :], turn]
        hessian = np.mean([t.hessian for t in last], 0) + np.diag(limits.pull**2)
        step = _step(hessian, turn.scores.sum(0) + (z - limits.centre) * limits.pull**2)
        rows = np.clip(z + _PARTS[:, None] * step, limits.floor, limits.roof)
        tried = limits.x(rows, found.x)
        z = rows[int(np.mean([loss(under.whiten(p.residual(found.plant, tried))).sum(-1) for p in drawn], 0).argmin())]
        places.append(z)
    places = np.stack(places[-_KEPT:])
    x = limits.x(places.mean(0), found.x)
    variance = _covariance(last, limits, clusters(problem)) + np.cov(places, rowvar=False).reshape(len(z), len(z))
    slopes = limits.slopes(x)
    return Ended(x, np.sqrt(np.einsum("ni,ij,nj->n", slopes, variance, slopes)))


def _looked(drawn: list[RolloutProblem], under: Metric, limits: Box, x: Array) -> _Turn:
    """What sets of starts tell at x (size,)."""
    every, pairs = np.arange(len(limits.scale)), len(drawn) * (len(drawn) - 1)
    white = [under.whiten(p.residual(limits.plant, x[None]))[0] for p in drawn]
    slopes = [jacobian(p, under, limits, x, r, every, _STEP) for p, r in zip(drawn, white, strict=True)]
    weight = loss_weight(np.sqrt(np.mean(np.square(white), 0))) ** 2
    curved = lambda a: np.einsum("smi,sm,smj->ij", a, weight, a)  # noqa: E731
    pulled = lambda a, r: np.einsum("smi,sm->si", a, weight * r)  # noqa: E731
    whole, apart = np.sum(slopes, 0), list(zip(slopes, white, strict=True))
    hessian = (curved(whole) - sum(map(curved, slopes))) / pairs
    scores = (pulled(whole, np.sum(white, 0)) - sum(pulled(a, r) for a, r in apart)) / pairs
    return _Turn(0.5 * (hessian + hessian.T), scores)


def _step(hessian: Array, gradient: Array) -> Array:
    """(f,) of Gauss and Newton, damped where the Hessian is flat and not gone where it is none."""
    scale, values, vectors = _principal(hessian)
    gain = np.maximum(values, 0) / (values**2 + _DAMPING**2)
    return np.clip(-scale * (vectors * gain @ vectors.T @ (scale * gradient)), -_FAR, _FAR)


def _principal(hessian: Array) -> tuple[Array, Array, Array]:
    """Scales (f,) that bring a Hessian to a unit diagonal, 0 for what shows nothing; values (f,) and vectors (f, f)."""
    diagonal = np.diag(hessian)
    shows = diagonal > 1e-9 * max(diagonal.max(), 1e-300)
    scale = np.where(shows, 1 / np.sqrt(np.where(shows, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(hessian * scale * scale[:, None])
    return scale, values, vectors


def _covariance(last: list[_Turn], limits: Box, blocks: NDArray[np.intp]) -> Array:
    """(f, f) of a model that fits, or, where that is more, of any, from the scatter between clusters of blocks."""
    scale, values, vectors = _principal(np.mean([t.hessian for t in last], 0) + np.diag(limits.pull**2))
    inverse = scale[:, None] * (vectors / np.maximum(values, _FLAT) @ vectors.T) * scale
    clustered = np.zeros((int(blocks.max()) + 1, len(scale)))
    np.add.at(clustered, blocks, np.mean([t.scores for t in last], 0))
    robust = inverse @ (clustered.T @ clustered) @ inverse
    wider = np.sqrt(np.maximum(np.diag(robust) / np.maximum(np.diag(inverse), 1e-300), 1.0))
    return inverse * wider * wider[:, None]
