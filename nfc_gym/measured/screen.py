"""Screening: which candidate effects could explain the residual, judged at realistic sizes with psi projected out.

A score test with secants: delay, dry friction and saturation have no useful derivative at zero, and are tried at
realistic sizes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, lsq_linear

from nfc_gym.measured.box import box
from nfc_gym.measured.fit import Fit, fit
from nfc_gym.measured.metric import Metric, loss, loss_weight
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.race import Race
from nfc_gym.physics.effects.base import Effect, overrides

Array = NDArray[np.float64]
_FAR = 4.0  # probing sizes beyond which a secant is not believed
# Of a realistic size, what a scout tries with all else as it is. A limit that few blocks reach does nothing when it is
# a fifth too wide and harm when it is a fifth too narrow: steps of a half would go over it.
_SHARES = 2.0 ** np.arange(-3, 0.01, 0.25)
_MIMIC, _MIMICS = 0.95, 2  # cosine from which a law does much the same as another one; how many such are refitted
_SCOUT = 0.7  # spread of a scout's draws, in scaled parameters


@dataclass(frozen=True)
class Screened:
    """One candidate after screening.

    Attributes:
      effect: the candidate.
      gain: drop of the (weighted, squared) loss that its best linear combination reaches, psi and accepted effects
        refitted; after `scout` or `pursue` the drop of the loss itself that was seen.
      theta: (k,) parameters to start a fit from.
      shift: (j,) change of the fitted model's scaled free parameters that goes with it.
      columns: (n, k') projected whitened change at the probe that did best, for the identifiability table.
    """

    effect: Effect
    gain: float
    theta: Array
    shift: Array
    columns: Array


def probe_sets(effect: Effect, every_size: bool = True) -> list[Array]:
    """Sets of realistic parameter vectors, (k', k) each: one row a sizing parameter, sharing the shape parameters.

    An effect with a chart of its own has one set, whose rows span its coordinates. Without `every_size` each shape is
    tried at its middle size only.
    """
    if overrides(effect, "chart"):
        rows = np.repeat(np.array([p.probes[0] for p in effect.params])[None], len(effect.params), 0)
        for i, p in enumerate(effect.params):
            rows[i, i] = p.probes[-1]
        return [rows]
    sizing = [i for i, p in enumerate(effect.params) if not p.shape]
    shaping = [i for i, p in enumerate(effect.params) if p.shape]
    ranks = max(len(effect.params[i].probes) for i in sizing)
    sets = []
    # A law with values of its own at each place tries one shape at all of them: their product would be endless.
    kinds = list(dict.fromkeys(effect.params[i].name.split("@")[0] for i in shaping))
    of = [kinds.index(effect.params[i].name.split("@")[0]) for i in shaping]
    probed = [effect.params[shaping[of.index(k)]].probes for k in range(len(kinds))]
    for choice in product(*(range(len(p)) for p in probed)):
        shape = [effect.params[i].probes[choice[k]] for i, k in zip(shaping, of, strict=True)]
        for rank in range(ranks) if every_size else [ranks // 2]:
            rows = np.repeat(effect.null[None], len(sizing), 0)
            rows[:, shaping] = shape
            for row, i in zip(rows, sizing, strict=True):
                probes = effect.params[i].probes
                row[i] = probes[min(rank, len(probes) - 1)]
            sets.append(rows)
    return sets


def sized(effect: Effect, theta: Array, share: float) -> Array:
    """The effect's parameters (k,) at a share of the size that theta has, along the coordinates that a fit walks in."""
    null = effect.null.copy()
    shape = np.array([p.shape for p in effect.params])
    null[shape] = theta[shape]
    start = effect.chart(null)
    return np.asarray(effect.unchart(start + share * (effect.chart(theta) - start)), np.float64)


def ladder(effect: Effect, theta: Array) -> Array:
    """(r, k) parameters at shares of a realistic size, to the side of null and with the shape that theta (k,) has."""
    whole = theta.copy()
    for i, p in enumerate(effect.params):
        if not p.shape:
            away = p.probes[len(p.probes) // 2] - p.null
            whole[i] = p.null + (-away if (theta[i] - p.null) * away < 0 else away)
    whole = np.clip(whole, effect.low, effect.high)
    return np.stack([sized(effect, whole, share) for share in _SHARES])


class Screen:
    """Screening against one fitted model: its residual, weights, and the tangent space of what is already fitted."""

    def __init__(self, problem: Problem, metric: Metric, current: Fit) -> None:
        self.problem, self.metric, self.current = problem, metric, current
        self.weight = loss_weight(current.white)
        self.target = (self.weight * current.white).ravel()
        self.full_tangent = (self.weight[..., None] * current.jacobian).reshape(len(self.target), -1)
        norms = np.linalg.norm(self.full_tangent, axis=0)
        tangent = self.full_tangent[:, norms > 1e-9] / norms[norms > 1e-9]
        self.basis = np.linalg.svd(tangent, full_matrices=False)[0] if tangent.size else np.zeros((len(self.target), 0))
        self.projected = self.project(self.target)

    @cached_property
    def _race(self) -> Race:
        return Race(self.problem, self.metric)

    def project(self, a: Array) -> Array:
        """Remove from (n,) or (n, k) what the fitted parameters can produce."""
        return a - self.basis @ (self.basis.T @ a)

    def try_one(self, effect: Effect, every_size: bool = True) -> Screened:
        """Probe one candidate at all its sizes, or at a middle one, in one batch."""
        sets = probe_sets(effect, every_size)
        plant = self.current.plant.with_effects([*self.current.plant.effects, effect])
        rows = np.concatenate(sets)
        x = np.concatenate([np.repeat(self.current.x[None], len(rows), 0), rows], 1)
        white = self.metric.whiten(self.problem.residual(plant, x))
        change = (self.weight * (white - self.current.white)).reshape(len(rows), -1).T
        best = Screened(effect, 0.0, sets[0][0], np.zeros(self.full_tangent.shape[1]), np.zeros((len(self.target), 0)))
        at = 0
        for probe in sets:
            raw = change[:, at : at + len(probe)]
            columns = self.project(raw)
            at += len(probe)
            gain, theta, multiple = self._combine(effect, probe, columns)
            if gain > best.gain or best.columns.shape[1] == 0:
                best = Screened(effect, gain, theta, _step(self.full_tangent, self.target + raw @ multiple), columns)
        return best

    def scout(self, found: Screened, rng: np.random.Generator, draws: int = 16) -> Screened:
        """Look around where a candidate's screening points, in all free parameters, and keep the best that was seen.

        Where bodies touch, straight lines from two probes lead astray: slip, for one, helps only with more friction
        than a model without slip can bear; and half the realistic size of a limit that few blocks reach may gain all
        that there is to gain, where the whole size gains nothing.
        """
        plant = self.current.plant.with_effects([*self.current.plant.effects, found.effect])
        before, after = box(self.current.plant), box(plant)
        here = before.at(self.current.x)
        moved = np.concatenate([before.x(here + found.shift, self.current.x), found.theta])
        rungs = [np.concatenate([self.current.x, t]) for t in (found.theta, *ladder(found.effect, found.theta))]
        values = self._race.losses(plant, np.stack(rungs))
        starts = [rungs[int(values.argmin())], moved]
        z = np.stack([after.at(x) for x in starts])
        around = z[rng.integers(2, size=draws)] + _SCOUT * rng.normal(size=(draws, z.shape[1]))
        z = np.clip(np.concatenate([z, around]), after.floor, after.roof)
        x = after.x(z, starts[0])
        values = self._race.losses(plant, x)
        best = int(values.argmin())
        gain = float(self.current.losses.sum() - values[best])
        theta = x[best, self.current.plant.size :]
        return replace(found, gain=gain, theta=theta, shift=z[best, : len(here)] - here)

    def pursue(self, found: Screened, rounds: int = 4) -> Screened:
        """Take a candidate a few steps further by the chord method: what it gains where straight lines do not hold.

        A rotor's inertia beside friction, for one, gains four times what its secant says.
        """
        plant = self.current.plant.with_effects([*self.current.plant.effects, found.effect])
        before = box(self.current.plant)
        here = before.at(self.current.x)
        starts = np.stack(
            [np.concatenate([x, found.theta]) for x in (self.current.x, before.x(here + found.shift, self.current.x))]
        )
        values = loss(self.metric.whiten(self.problem.residual(plant, starts))).sum(-1)
        start, known = starts[int(values.argmin())], self.current.jacobian
        fitted = fit(self.problem, self.metric, plant, start, rounds, known=known)
        gain = float(self.current.losses.sum() - fitted.losses.sum())
        theta = fitted.x[self.current.plant.size :]
        return replace(found, gain=gain, theta=theta, shift=before.at(fitted.x[: self.current.plant.size]) - here)

    def _combine(self, effect: Effect, probe: Array, columns: Array) -> tuple[float, Array, Array]:
        """Best multiples of the probes within the parameters' bounds, and what they gain."""
        norms = np.linalg.norm(columns, axis=0)
        if not (norms > 1e-9).any():
            return 0.0, probe[0], np.zeros(len(probe))
        solution = np.linalg.lstsq(columns / np.maximum(norms, 1e-12), -self.projected, rcond=1e-6)[0] / np.maximum(
            norms, 1e-12
        )
        if overrides(effect, "chart"):
            null = effect.chart(effect.null)
            spanned = effect.chart(probe) - null
            free = np.asarray(effect.unchart(np.asarray(null + solution @ spanned)), np.float64)
            theta = np.clip(free, effect.low, effect.high)
            if (theta != free).any():
                theta = _charted(effect, columns, -self.projected, spanned, [theta, *probe])
            multiple = np.asarray(np.linalg.lstsq(spanned.T, effect.chart(theta) - null, rcond=None)[0], np.float64)
            return self._gain(columns, multiple), theta, multiple
        sizing = [i for i, p in enumerate(effect.params) if not p.shape]
        size = (probe - effect.null)[np.arange(len(probe)), sizing]
        low, high = (effect.low - effect.null)[sizing] / size, (effect.high - effect.null)[sizing] / size
        low, high = np.minimum(low, high), np.maximum(low, high)
        multiple = _bounded(columns, -self.projected, solution, np.maximum(low, -_FAR), np.minimum(high, _FAR))
        theta = probe[0].copy()
        theta[sizing] = effect.null[sizing] + multiple * size
        return self._gain(columns, multiple), np.clip(theta, effect.low, effect.high), multiple

    def _gain(self, columns: Array, multiple: Array) -> float:
        after = self.projected + columns @ multiple
        return float(self.projected @ self.projected - after @ after)

    def chance(
        self, found: Sequence[Screened], blocks: NDArray[np.intp], rng: np.random.Generator, draws: int = 199
    ) -> dict[str, float]:
        """Gain of each candidate that only 1 % of residuals without any effect would bring the luckiest candidate to.

        What the best candidate leaves over takes a random sign in every block: such a residual is as large and as
        correlated as the real one and holds nothing, yet the best of many candidates gains from it. Gains are compared
        in units of each candidate's own average by chance, since laws with more parameters gain more.
        """
        kept = [s for s in found if s.columns.shape[1]]
        if not kept:
            return {}
        spans = [_span(s.columns) for s in kept]
        rest = self.projected - spans[0] @ (spans[0].T @ self.projected)
        signs = rng.choice([-1.0, 1.0], (draws, int(blocks.max()) + 1))[:, blocks]
        targets = (signs[:, :, None] * rest.reshape(-1, self.current.white.shape[1])).reshape(draws, -1)
        gains = np.array([((targets @ q) ** 2).sum(1) for q in spans])
        mean = np.maximum(gains.mean(1), 1e-12)
        luckiest = float(np.quantile((gains / mean[:, None]).max(0), 0.99))
        return {s.effect.id: luckiest * float(m) for s, m in zip(kept, mean, strict=True)}


def answer(current: Fit, white: Array) -> Array:
    """(p, j) steps of a fitted model's scaled free parameters that answer best what is left of (p, S, m) residuals."""
    weight = loss_weight(current.white)
    tangent = (weight[..., None] * current.jacobian).reshape(current.white.size, current.jacobian.shape[-1])
    return _step(tangent, (weight * white).reshape(len(white), -1).T).T


def _step(tangent: Array, target: Array) -> Array:
    """Steps (j,) or (j, p) along (n, j) that take most from (n,) or (n, p); what hardly shows stays put."""
    if not tangent.shape[1]:
        return np.zeros((0, *target.shape[1:]))
    return np.asarray(np.linalg.lstsq(tangent, -target, rcond=1e-3)[0], np.float64)


def likeness(one: Screened, other: Screened, projected: Array) -> float:
    """Cosine between what one candidate does about a projected residual (n,) and the nearest that another could do."""
    if not (one.columns.shape[1] and other.columns.shape[1]):
        return 0.0
    basis = _span(one.columns)
    does = basis @ (basis.T @ projected)
    return float(np.linalg.norm(_span(other.columns).T @ does) / max(float(np.linalg.norm(does)), 1e-12))


def mimics(one: Screened, others: Sequence[Screened], projected: Array) -> list[Screened]:
    """The few of other candidates that do nearly the same as one about a projected residual (n,), likest first."""
    near = [(likeness(one, s, projected), s) for s in others]
    return [s for cosine, s in sorted(near, key=lambda pair: -pair[0])[:_MIMICS] if cosine > _MIMIC]


def _bounded(columns: Array, target: Array, free: Array, low: Array, high: Array) -> Array:
    """Multiples (k,) of columns (n, k) that come nearest to a target within bounds; `free` is the answer without them.

    Cutting the free answer's entries one by one would leave a law's force without the drag that balances it.
    """
    norms = np.linalg.norm(columns, axis=0)
    shows = norms > 1e-8 * norms.max()
    free = np.where(shows, free, 0.0)
    if ((free >= low) & (free <= high)).all():
        return free
    small = np.asarray(np.linalg.qr(np.column_stack([columns[:, shows], target]), mode="r"), np.float64)
    out = np.zeros(len(free))
    out[shows] = lsq_linear(small[:, :-1], small[:, -1], (low[shows], high[shows])).x
    return out


def _charted(effect: Effect, columns: Array, target: Array, spanned: Array, starts: Sequence[Array]) -> Array:
    """Parameters (k,) within their bounds whose coordinates, in columns (n, k) of (k, k) steps, come nearest a target.

    A lump whose mass psi can take up as well may weigh less than nothing to a straight line; cut to no mass at all, it
    has no place either, and a lump that shifts the centre of mass as the logs want would count for nothing.
    """
    small = np.asarray(np.linalg.qr(np.column_stack([columns, target]), mode="r"), np.float64)
    null, width = effect.chart(effect.null), effect.high - effect.low

    def left(theta: Array) -> Array:
        multiple = np.linalg.lstsq(spanned.T, effect.chart(theta) - null, rcond=None)[0]
        return np.asarray(small[:, :-1] @ multiple - small[:, -1], np.float64)

    inside = [np.clip(t, effect.low + 1e-6 * width, effect.high - 1e-6 * width) for t in starts]
    found = [least_squares(left, t, bounds=(effect.low, effect.high), x_scale=width, max_nfev=50) for t in inside]
    return np.asarray(min(found, key=lambda f: f.cost).x, np.float64)


def _span(columns: Array) -> Array:
    """Orthonormal basis of the columns that are not nearly zero or nearly copies."""
    norms = np.linalg.norm(columns, axis=0)
    u, size, _ = np.linalg.svd(columns[:, norms > 1e-9] / norms[norms > 1e-9], full_matrices=False)
    return u[:, size > 1e-6]


def screen_all(screen: Screen, candidates: Sequence[Effect], every_size: bool = True) -> list[Screened]:
    """Screen every candidate, best gain first."""
    return sorted((screen.try_one(effect, every_size) for effect in candidates), key=lambda s: -s.gain)
