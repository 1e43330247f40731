"""Box-constrained least squares of psi and effects' parameters on whitened residuals; Jacobians from batched runs."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import chdtri

from nfc_gym.measured.box import Box, box
from nfc_gym.measured.metric import TURN, Metric, loss, loss_weight
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.race import Race
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
# Steps of the differences, in scaled parameters. Where bodies touch, the motion of some blocks jumps at some parameter
# values. A coarse step averages over the jumps and a tiny one nearly always misses them; any step between counts a jump
# for a steep slope. A rough fit therefore goes from the first to the second.
COARSE, FINE, TINY = 1e-1, 2e-4, 1e-5
_UNSEEN = 1e-8  # of the largest column's norm: what the differences' own rounding makes of one that is zero
_SPREAD = 0.3  # of a polish's first draws, in scaled parameters
TURNING = 2  # iterations of a candidate's rough fit that one set of slopes serves, turned with the step in between
_PARTS, _RIDGE = np.array([1.0, 0.5, 0.2, 0.05]), 0.01  # of a step that are tried; of a Hessian's diagonal


@dataclass(frozen=True)
class Fit:
    """A fitted model.

    Attributes:
      plant: the machine with the effects that were fitted.
      x: (size,) parameters.
      white: (S, m) whitened residual at x.
      jacobian: (S, m, f) by scaled free coordinates (`Box`), at x or near it.
    """

    plant: Plant
    x: Array
    white: Array
    jacobian: Array

    @property
    def losses(self) -> Array:
        """(S,) loss of each block."""
        return loss(self.white)


def jacobian(
    problem: Problem, metric: Metric, limits: Box, x: Array, base: Array, which: NDArray[np.intp], size: float = FINE
) -> Array:
    """(S, m, len(which)) derivative of the whitened residual by scaled free coordinates, one-sided, in one batch.

    Args:
      base: (S, m) whitened residual at x.
      which: of the free coordinates.
      size: step in scaled coordinates.
    """
    if not len(which):
        return np.zeros((*base.shape, 0))
    z = limits.at(x)
    step = np.where(z[which] + size > limits.roof[which], -size, size)
    rows = np.repeat(z[None], len(which), 0)
    rows[np.arange(len(which)), which] += step
    moved = metric.whiten(problem.residual(limits.plant, limits.x(rows, x)))
    slopes = (moved - base) / step[:, None, None]
    norms = np.linalg.norm(slopes.reshape(len(which), -1), axis=1)
    slopes[norms < _UNSEEN * norms.max(initial=0.0)] = 0.0
    return np.moveaxis(slopes, 0, -1)


def fit(
    problem: Problem,
    metric: Metric,
    plant: Plant,
    start: Array,
    rounds: int = 15,
    known: Array | None = None,
    tick: Callable[[], None] = lambda: None,
    serve: int = 1,
) -> Fit:
    """Minimise the robust loss over free parameters within their box.

    Args:
      start: (size,) full parameter vector to start from.
      rounds: iterations at most.
      known: (S, m, j) Jacobian of the first j free parameters to reuse as it is: the chord method, for refits in which
        psi moves little.
      tick: called at every iteration.
      serve: iterations, where bodies touch, that slopes serve before they are taken anew. In between each takes from
        the step that led to it what slopes along it are (Broyden 1965), at no cost: beside the jumps there that is
        nearly as good as a difference. The model to beat is to have slopes of its own at each: what it is still short
        of would be a candidate's to claim.

    Returns:
      The fit; never worse than the start under the loss.
    """
    ask = _Asked(problem, metric, plant, start, known, tick, serve)
    x = _descended(ask, rounds)
    found = ask.slopes(x, COARSE) if problem.rough and len(ask.limits.scale) else ask.jacobian
    x = _quieted(ask, x, found)
    return Fit(plant, x, ask.white(x), found)


def fitted(problem: Problem, metric: Metric, plant: Plant, start: Array, rounds: int = 15, serve: int = 1) -> Array:
    """The same where the parameters (size,) alone are wanted: slopes at the end are spared."""
    ask = _Asked(problem, metric, plant, start, None, lambda: None, serve)
    x = _descended(ask, rounds)
    found = ask.jacobian
    if problem.rough and not found.any((0, 1)).all():  # what tiny steps do not show larger ones may
        found = ask.slopes(x, COARSE)
    return _quieted(ask, x, found)


def _descended(ask: "_Asked", rounds: int) -> Array:
    """(size,) where least squares end after so many iterations at most."""
    limits, problem = ask.limits, ask.problem
    room = 1e-6 * (limits.roof - limits.floor)
    x = ask.start.copy()
    stages = ((COARSE, rounds // 2), (TINY, rounds - rounds // 2)) if problem.rough else ((FINE, rounds),)
    for size, share in stages if len(limits.scale) else ():
        solved = least_squares(
            ask.residual, np.clip(limits.at(x), limits.floor + room, limits.roof - room),
            lambda z, size=size: ask.derivative(z, size),  # pyright: ignore[reportArgumentType] (no stubs)
            (limits.floor, limits.roof), loss="soft_l1", f_scale=TURN, x_scale="jac",
            max_nfev=max(share, 1), ftol=1e-5, xtol=1e-5, gtol=1e-8,
        )  # fmt: skip
        x = limits.x(solved.x, ask.start)
    return x


def _quieted(ask: "_Asked", x: Array, found: Array) -> Array:
    """(size,) the same, but what slopes (S, m, f) say nothing of stays at null, unless that would change the motion."""
    unseen = ~found.any((0, 1))
    if not unseen.any():
        return x
    limits = ask.limits
    quiet = limits.x(np.where(unseen, limits.centre, limits.at(x)), ask.start)
    stays = loss(ask.white(quiet)).sum() <= loss(ask.white(x)).sum() * (1 + 1e-9)
    return quiet if stays else x


def fit_last(problem: Problem, metric: Metric, plant: Plant, start: Array, count: int, rounds: int = 4) -> Array:
    """Fit the last `count` free parameters with all others held: (size,) parameters, never worse than the start.

    For a plainer law in the place of one that contains it: where bodies touch, the fit of everything at once may lead
    away from the psi that the first was fitted with before the law has the values that go with it.
    """
    limits = box(plant)
    which = np.arange(len(limits.scale) - count, len(limits.scale))
    x, base = start, metric.whiten(problem.residual(plant, start[None]))[0]
    for _ in range(rounds):
        slopes = jacobian(problem, metric, limits, x, base, which, COARSE if problem.rough else FINE)
        weight, z = loss_weight(base) ** 2, limits.at(x)
        hessian = np.einsum("smi,sm,smj->ij", slopes, weight, slopes)
        ridge = _RIDGE * np.diag(np.diag(hessian)) + 1e-12 * np.eye(count)
        step = np.linalg.solve(hessian + ridge, np.einsum("smi,sm->i", slopes, weight * base))
        rows = np.repeat(z[None], len(_PARTS), 0)
        rows[:, which] = np.clip(rows[:, which] - _PARTS[:, None] * step, limits.floor[which], limits.roof[which])
        found = metric.whiten(problem.residual(plant, limits.x(rows, x)))
        left = loss(found).sum(-1)
        best = int(left.argmin())
        if not left[best] < loss(base).sum() * (1 - 1e-4):
            break
        x, base = limits.x(rows[best], x), found[best]
    return x


class _Asked:
    """What an optimiser asks of a fit: residuals and slopes at scaled coordinates; arguments as for `fit`.

    Attributes:
      limits: the box.
      jacobian: (S, m, f) slopes that were asked for last.
    """

    def __init__(
        self,
        problem: Problem,
        metric: Metric,
        plant: Plant,
        start: Array,
        known: Array | None,
        tick: Callable,
        serve: int,
    ) -> None:
        self.problem, self.metric, self.plant, self.start, self.known, self.tick = (
            problem, metric, plant, start, known, tick,
        )  # fmt: skip
        self.serve = serve if problem.rough else 1
        self.limits = box(plant)
        self.fresh = np.arange(0 if known is None else known.shape[-1], len(self.limits.scale))
        self.jacobian = np.zeros((*problem.mask.shape, 0))
        self._last: tuple[Array, Array] | None = None
        self._sloped: tuple[Array, Array, float] | None = None  # where the slopes are from, and by which difference
        self._age = 0  # iterations since they were taken anew

    def white(self, x: Array) -> Array:
        """(S, m) whitened residual; the optimiser asks for slopes where it has just asked for the residual."""
        if self._last is None or not np.array_equal(self._last[0], x):
            self._last = x.copy(), self.metric.whiten(self.problem.residual(self.plant, x[None]))[0]
        return self._last[1]

    def residual(self, z: Array) -> Array:
        """(S m + f,) whitened residual, and how far the weak priors are pulled."""
        white = self.white(self.limits.x(z, self.start))
        return np.concatenate([white.ravel(), (z - self.limits.centre) * self.limits.pull])

    def derivative(self, z: Array, size: float) -> Array:
        """(S m + f, f) its slopes, by differences of that size, or those of the last iteration turned (see `fit`)."""
        self.tick()
        x = self.limits.x(z, self.start)
        turned = self._turned(z, x, size)
        self._age = 1 if turned is None else self._age + 1
        self.jacobian = self.slopes(x, size) if turned is None else turned
        self._sloped = z.copy(), self.white(x), size
        return np.concatenate([self.jacobian.reshape(-1, len(z)), np.diag(self.limits.pull)])

    def _turned(self, z: Array, x: Array, size: float) -> Array | None:
        """(S, m, f) the slopes at hand, turned to explain the step to z; None where they are to be taken anew."""
        if self._sloped is None or self._sloped[2] != size or self._age >= self.serve or not len(self.fresh):
            return None
        step = z - self._sloped[0]
        missed = self.white(x) - self._sloped[1] - self.jacobian @ step
        length = float(step @ step)
        return self.jacobian + missed[..., None] * step / length if length > 0 else None

    def slopes(self, x: Array, size: float) -> Array:
        """(S, m, f) of the whitened residual; those that are known are not taken anew."""
        found = jacobian(self.problem, self.metric, self.limits, x, self.white(x), self.fresh, size)
        return found if self.known is None else np.concatenate([self.known, found], -1)


def stand(problem: Problem, metric: Metric, plant: Plant, x: Array) -> Fit:
    """A model as it stands at x (size,): its residual and slopes there, nothing moved."""
    base = metric.whiten(problem.residual(plant, x[None]))[0]
    limits = box(plant)
    step = COARSE if problem.rough else FINE
    return Fit(plant, x, base, jacobian(problem, metric, limits, x, base, np.arange(len(limits.scale)), step))


def polish(problem: Problem, metric: Metric, plant: Plant, x: Array, evaluations: int, seed: int) -> Array:
    """Go on without derivatives (CMA-ES, Hansen 2001) from a fit (size,) in which roughness may have stopped them.

    Args:
      evaluations: parameter vectors to try.
      seed: of its draws.

    Returns:
      The better of both.
    """
    limits = box(plant)
    if not len(limits.scale):
        return x
    z = np.clip(limits.at(x), limits.floor, limits.roof)
    best, value = z, objective(problem, metric, limits, z[None], x)[0]
    if len(z) == 1:  # CMA-ES wants two dimensions: a scan does for one
        draws = np.linspace(limits.floor, limits.roof, evaluations)
        values = objective(problem, metric, limits, draws, x)
        best = draws[values.argmin()] if values.min() < value else best
    else:
        import cma  # where it is used: it imports matplotlib, a second that few commands need

        bounds = [limits.floor.tolist(), limits.roof.tolist()]
        options = {"bounds": bounds, "maxfevals": evaluations, "verbose": -9, "seed": seed + 1}  # 0: the time of day
        search, race = cma.CMAEvolutionStrategy(z, _SPREAD, options), Race(problem, metric)
        while not search.stop():  # who is best counts, and roughly how the others follow
            draws = np.array(search.ask())
            losses, ranks = race.ranked(plant, limits.x(draws, x))
            pulled = limits.pulled(draws)
            first = (losses + pulled).argmin()
            if losses[first] + pulled[first] < value:
                best, value = draws[first], losses[first] + pulled[first]
            search.tell(list(draws), (ranks + pulled).tolist())
    if best is z:
        return x
    return fitted(problem, metric, plant, limits.x(best, x), 4)


def objective(problem: Problem, metric: Metric, limits: Box, z: Array, around: Array) -> Array:
    """(P,) what a fit minimises, at scaled coordinates (P, f)."""
    white = metric.whiten(problem.residual(limits.plant, limits.x(z, around)))
    return loss(white).sum(-1) + limits.pulled(z)


def uncertainty(result: Fit, blocks: NDArray[np.intp]) -> Array:
    """(size,) standard deviations of the parameters, robust to a model that does not fit: clustered by block.

    Args:
      blocks: (S,) cluster of each block of numbers (neighbouring segments share one).

    Anchored parameters get 0; directions that the data do not show keep the prior's spread, which for effects is
    infinite.
    """
    limits = box(result.plant)
    slopes = limits.slopes(result.x)
    variances = [np.einsum("ni,ij,nj->n", slopes, c, slopes) for c in _covariances(result, limits, blocks)]
    sd = np.sqrt(np.maximum(np.maximum(*variances), 0.0))
    unseen = ~result.jacobian.any((0, 1)) & (limits.pull == 0)
    return np.where((slopes[:, unseen] != 0).any(1), np.inf, sd)


def differs(result: Fit, blocks: NDArray[np.intp], effect: Effect, level: float = 0.95) -> bool:
    """Whether the sizes of a fitted effect, taken together, differ from those that do nothing (Wald's test, 1943).

    One number alone may be uncertain because another can stand in for it; all of them at once cannot, in what is there.
    """
    limits = box(result.plant)
    sizes = np.zeros(len(limits.free), bool)
    at = len(result.plant.space)
    for e in result.plant.effects:
        if e is effect:
            sizes[at : at + len(e.params)] = [not p.shape for p in e.params]
        at += len(e.params)
    away = (limits.at(result.x) - limits.at(result.plant.null))[sizes[limits.free]]
    most = float(chdtri(len(away), 1 - level))
    own = np.ix_(sizes[limits.free], sizes[limits.free])
    plain, robust = _covariances(result, limits, blocks)
    # Few clusters leave directions in which nothing scatters, and a distance along those would count for nothing.
    usable = [plain, robust] if blocks.max() >= 2 * len(away) else [plain]
    seen = [away @ np.linalg.pinv(c[own], hermitian=True) @ away for c in usable]
    return bool(min(seen) > most)


def _covariances(result: Fit, limits: Box, blocks: NDArray[np.intp]) -> tuple[Array, Array]:
    """(f, f) each, in scaled coordinates: of a model that fits, and of any, from the scatter between the clusters."""
    weight = loss_weight(result.white) ** 2
    jac = result.jacobian
    hessian = np.einsum("smi,sm,smj->ij", jac, weight, jac) + np.diag(limits.pull**2)
    scores = np.einsum("smi,sm->si", jac, weight * result.white)
    clustered = np.zeros((int(blocks.max()) + 1, len(limits.scale)))
    np.add.at(clustered, blocks, scores)
    inverse = np.linalg.pinv(hessian, rcond=1e-12, hermitian=True)
    return inverse, inverse @ (clustered.T @ clustered) @ inverse
