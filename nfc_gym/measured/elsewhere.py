"""Fits that begin elsewhere: where bodies touch, least squares end in one of many hollows, and not in the deepest.

An ant's legs trade mass with one another: fits of the same logs that began elsewhere end with hips lighter by a tenth,
and the one that expects its own errors best is nearer to the truth than the one whose errors are smallest.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.box import Box, box
from nfc_gym.measured.fit import TURNING, Fit, fit, fitted
from nfc_gym.measured.metric import Metric, loss, metric
from nfc_gym.measured.owned import Told, heard
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.race import lost
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
STARTS = 3
_AWAY = 0.3  # standard deviation of the starts about a fit, in scaled parameters
_ROUNDS = 10  # iterations of each fit
_SAME = 3.0  # standard errors, root mean square over the parameters, within which two fits ended in one hollow
_THIN, _ENOUGH = 3, 12  # hollows race third by third of the blocks, where each has so many
_DEEPER = 10.0  # loss by which a fit from another size must be better
_SETTLED = 2  # fits in a row that end where others have: more of them would too


@dataclass(frozen=True)
class Ended:
    """Where fits of one model to the same data ended.

    Attributes:
      x: (size,) the likeliest.
      unsure: (size,) root mean square distance of the others from it: what the search for it leaves open.
      told: (size,) where it told the noise that it expects, see `owned.heard`; None: it was not asked.
    """

    x: Array
    unsure: Array
    told: Array | None = None


def hollows(
    problem: Problem,
    under: Metric,
    extra: Array,
    found: Fit,
    seed: int,
    others: tuple[Array, ...] = (),
    starts: int = STARTS,
    tick: Callable[[int], None] = lambda start: None,
    told: Array | None = None,
) -> Ended:
    """Fit again from starts about a fit, and keep the likeliest, each by the noise that it expects itself.

    It ends early where fits keep ending in hollows that others have found.

    Args:
      problem: measured blocks; where nothing touches, the fit at hand is the answer.
      under: metric to fit under.
      extra: (m,) its slack, which all share.
      found: the fit at hand.
      seed: of the starts.
      others: (size,) each, starts besides.
      starts: how many are drawn.
      tick: called with the number of each start, from 1.
      told: (size,) where the noise of `under` was told.
    """
    if not problem.rough:
        return Ended(found.x, np.zeros(len(found.x)))
    plant, limits = found.plant, box(found.plant)
    around = np.random.default_rng(seed).normal(size=(starts, len(limits.scale)))
    z = np.clip(limits.at(found.x) + _AWAY * around, limits.floor, limits.roof)
    ends, apart, quiet = [found.x], [found.x], 0
    serve = TURNING if plant.effects else 1  # what psi alone is short of would be an effect's to claim
    for number, start in enumerate([*others, *limits.x(z, found.x)], 1):
        tick(number)
        ends.append(fitted(problem, under, plant, start, _ROUNDS, serve))
        new = all(_errors_between(found, limits, ends[-1], x) > _SAME for x in apart)
        quiet = 0 if new else quiet + 1
        if new:
            apart.append(ends[-1])
        elif quiet == _SETTLED:
            break
    before: list[Told] = [] if told is None else [(plant, told)]
    told_at = lambda x: heard(found, before, x)[1]  # noqa: E731
    best = _likeliest(problem, extra, plant, apart, told_at)
    away = np.stack([x for x in ends if x is not best] or [best]) - best
    return Ended(best, np.sqrt((away**2).mean(0)), told_at(best))


def resized(problem: Problem, metric: Metric, found: Fit) -> Fit:
    """A fit again from the most promising of the sizes that its effects are screened at, if that ends clearly lower.

    A delay by a period of what is measured too little, or found beside another law that was not there yet, is a hollow
    of its own: what is near says that it is best, and only the true size says that it is not.
    """
    tries, at = [], len(found.plant.space)
    for effect in found.plant.effects:
        for p in effect.params:
            for probe in () if p.shape else p.probes:
                x = found.x.copy()
                x[at] = probe
                tries.append(x)
            at += 1
    if not tries:
        return found
    with np.errstate(invalid="ignore", over="ignore"):
        tried = loss(metric.whiten(problem.residual(found.plant, np.stack(tries)))).sum(-1)
    tried = np.where(np.isfinite(tried), tried, np.inf)  # some sizes are more than the simulation bears
    if np.isinf(tried).all():
        return found
    again = fit(problem, metric, found.plant, tries[int(tried.argmin())], _ROUNDS)
    return again if again.losses.sum() < found.losses.sum() - _DEEPER else found


def _errors_between(found: Fit, limits: Box, a: Array, b: Array) -> float:
    """Distance of two ends (size,) in standard errors of a fit near them, root mean square over its parameters."""
    moved = found.jacobian @ (limits.at(a) - limits.at(b))
    return float(np.sqrt((moved**2).sum() / max(len(limits.scale), 1)))


def _likeliest(
    problem: Problem, extra: Array, plant: Plant, ends: list[Array], told_at: Callable[[Array], Array]
) -> Array:
    """The end (size,) that is the likeliest, each by the noise that it expects; within one hollow all expect the same.

    What a model expects takes some fifty roll-outs of every block; who is far behind on a third of them, or on two, is
    not asked of the rest (`race`).
    """
    thirds = _THIN if len(problem) >= _THIN * _ENOUGH else 1
    told = np.zeros((len(ends), 0))
    for third in range(thirds if len(ends) > 1 else 0):
        part = problem if thirds == 1 else problem.part(np.arange(third, len(problem), thirds))
        new = [surprises(part, part.covariance(plant, told_at(x)), extra, plant, x) for x in ends]
        told = np.concatenate([told, new], 1)
        left = np.flatnonzero(~lost(told))
        ends, told = [ends[i] for i in left], told[left]
        if len(ends) == 1:
            break
    return ends[int(told.sum(1).argmin())]


def surprises(problem: Problem, sigma: Array, extra: Array, plant: Plant, x: Array) -> Array:
    """(S,) of a model at x (size,), by noise (S, m, m) and slack (m,): `Metric.surprise` of each block."""
    return metric(problem, sigma, extra).surprise(problem.residual(plant, x[None]))[0]
