"""What the search found, said on logs nobody fitted to: errors, chi-squared, shares, and a verdict."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from nfc_gym.core.errors import InputError
from nfc_gym.measured.contest import bootstrap, clusters
from nfc_gym.measured.fit import Fit, uncertainty
from nfc_gym.measured.metric import Metric, beyond, metric, taken
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.ranking import Round
from nfc_gym.physics.effects.conditions import Conditioned
from nfc_gym.physics.effects.each import Each
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
CAUSE = 0.5  # of the error beyond the noise: what claims must take away of it to be causes where something remains
_OWNED, _AGREE = 2, 0.01  # twins that have covariances of their own; share of chi-squared that these may matter
_TAIL = 1.96  # standard deviations to either side, within which 95 % lie
_WILD = 1e4  # of a squared whitened number: more counts as this much,
_TIMES = 1e3  # or as so many times what is usual, where that is far beyond the noise


@dataclass(frozen=True)
class Models:
    """The three models that are compared: (plant, x) each."""

    nominal: tuple[Plant, Array]
    calibrated: tuple[Plant, Array]
    extended: tuple[Plant, Array]

    def items(self) -> list[tuple[str, Plant, Array]]:
        """(stage, plant, x) in order."""
        return [(n, *getattr(self, n)) for n in ("nominal", "calibrated", "extended")]


@dataclass(frozen=True)
class Verified:
    """Residuals on the verification logs, in their own units and whitened by the noise alone.

    residual and white: stage -> (S, m); null: (K,) chi-squared of models without any unknown effect; shares: (K, C)
    what each cluster of blocks adds to it; floor: (m,) mean square of each number, whitened, of such models; most:
    what a squared whitened number counts at most.
    """

    problem: Problem
    residual: dict[str, Array]
    white: dict[str, Array]
    sigma: Array
    null: Array
    shares: Array
    floor: Array
    most: float = _WILD

    def chi2(self, stage: str) -> float:
        """Mean square whitened residual; about 1 where noise explains it."""
        return mean_square(self.problem, self.white[stage], self.most)

    def squares(self, stage: str, elsewhere: float = 0.0) -> Array:
        """(S, m) squared whitened residuals, bounded; `elsewhere` where they do not count."""
        return np.where(self.problem.mask, squared(self.white[stage], self.most), elsewhere)

    def column_means(self, stage: str) -> Array:
        """(m,) mean of these over the blocks in which each counts; 0 in none."""
        return column_means(self.problem, self.white[stage], self.most)


def squared(white: Array, most: float = _WILD) -> Array:
    """Squares of whitened numbers, bounded so that one wild block does not decide."""
    return np.minimum(white**2, most)


def mean_square(problem: Problem, white: Array, most: float = _WILD) -> float:
    """Mean of whitened squares over what counts."""
    return float(squared(white, most)[problem.mask].mean())


def column_means(problem: Problem, white: Array, most: float = _WILD) -> Array:
    """(m,) mean of whitened squares (S, m) of each compared number over the blocks in which it counts; 0 in none."""
    squares = np.where(problem.mask, squared(white, most), 0.0)
    return squares.sum(0) / np.maximum(problem.mask.sum(0), 1)


def bound(problem: Problem, white: Array) -> float:
    """What a squared whitened number counts at most, given what is usual (S, m).

    Where noise is next to nothing beside what a model leaves, as in logs that were smoothed, every number may lie a
    thousand standard errors off, and a fixed bound would make all models alike.
    """
    usual = float(np.median(white[problem.mask] ** 2))
    return max(_WILD, _TIMES * usual) if np.isfinite(usual) else _WILD


def twin(
    problem: Problem, under: Metric, plant: Plant, x: Array, rng: np.random.Generator, shared: bool = False
) -> tuple[Problem, Array] | None:
    """A problem made of a model's own motion with fresh noise, and its whitened residual (S, m) under that model.

    Args:
      problem, under: what it is the twin of, and the metric of that at the model.
      plant, x: the model.
      shared: take that metric for the twin's too, which begins within the noise of what it is the twin of; so it is
        where bodies touch, since a covariance is dear there.

    Returns:
      None where the model is unstable on every segment.
    """
    made = problem.synthetic(plant, x, rng)
    if not len(made):
        return None
    measure = _shared(problem, under, made) if shared or problem.rough else metric(made, made.covariance(plant, x))
    return made, measure.whiten(made.residual(plant, x[None]))[0]


def _shared(problem: Problem, under: Metric, made: Problem) -> Metric:
    """The metric of a problem for its twin, which lacks the blocks that came apart."""
    return under if len(made) == len(problem) else under.take(_rows(problem, made))


def _rows(problem: Problem, made: Problem) -> NDArray[np.intp]:
    """(S',) which blocks of a problem its twin has."""
    key = lambda of: zip(of.log_of.tolist(), of.time_of.tolist(), strict=True)  # noqa: E731
    rows = {k: i for i, k in enumerate(key(problem))}
    return np.array([rows[k] for k in key(made)], np.intp)


def verify(problem: Problem, models: Models, replicas: int, rng: np.random.Generator) -> Verified:
    """Predict the verification logs with all three models, and what chi-squared a perfect model would show.

    The null replicas are the extended model's own motion with fresh noise, through the same pipeline.

    Raises:
      InputError: the extended model is unstable on all of these logs.
    """
    plant, x = models.extended
    sigma = problem.covariance(plant, x)
    measure = metric(problem, sigma)
    residual, white_of = {}, {}
    for stage, p, v in models.items():
        r = problem.residual(p, v[None])
        residual[stage], white_of[stage] = r[0], measure.whiten(r)[0]
    most, null, shares, floors = bound(problem, white_of["calibrated"]), [], [], []
    alike, owned = problem.rough, list[tuple[float, float]]()
    for _ in range(replicas):
        made = twin(problem, measure, plant, x, rng, alike)
        if made is None:
            raise InputError(
                "the model that fits the other logs is unstable on every segment that verifies, at half the physics "
                "step: look whether these logs are of the same machine, in the same units (`nfc-gym check`)"
            )
        null.append(mean_square(*made, most))
        shares.append(_shares(problem, *made, most))
        floors.append(column_means(*made, most))
        if not alike:  # a covariance is most of what a twin costs: where the first twins' say nothing new they do
            white = _shared(problem, measure, made[0]).whiten(made[0].residual(plant, x[None]))[0]
            owned.append((null[-1], mean_square(made[0], white, most)))
            alike = len(owned) == _OWNED and _agree(owned)
    floor = np.mean(floors, 0) if floors else np.ones(problem.mask.shape[1])
    told = np.array(shares).reshape(replicas, -1)
    return Verified(problem, residual, white_of, sigma, np.array(null), told, floor, most)


def _agree(owned: Sequence[tuple[float, float]]) -> bool:
    """Whether twins show what they show by covariances of their own by the shared one, too."""
    own, shared = np.sum(owned, 0)
    return bool(abs(shared - own) <= _AGREE * own)


def _shares(problem: Problem, made: Problem, white: Array, most: float) -> Array:
    """(C,) what each cluster of a problem's blocks adds to the chi-squared of its twin, whitened (S, m)."""
    blocks = clusters(problem)
    squares = np.where(made.mask, squared(white, most), 0.0).sum(1)
    of = blocks[_rows(problem, made)]
    return np.bincount(of, squares, int(blocks.max()) + 1) / max(int(made.mask.sum()), 1)


def errors(v: Verified) -> dict[str, Any]:
    """Root-mean-square error of each group of quantities at each horizon, before and after, and the noise floor."""
    c = v.problem.columns
    levels = sorted(set(c.horizon.tolist()))
    groups: dict[str, Any] = {}
    for group in dict.fromkeys(c.group):
        of = np.array([g == group for g in c.group])
        row: dict[str, Any] = {"unit": c.unit[int(np.flatnonzero(of)[0])]}
        for stage, r in v.residual.items():
            row[stage] = [_rms(r, v.problem.mask & (of & (c.horizon == h))) for h in levels]
        floor = np.sqrt(np.einsum("sii->si", v.sigma))
        row["noise_floor"] = [_rms(floor, v.problem.mask & (of & (c.horizon == h))) for h in levels]
        groups[group] = row
    return {"horizons_s": levels, "groups": groups}


def taken_away(v: Verified, errors: dict[str, Any]) -> float:
    """Share of the error beyond the noise that the extended model takes away (see `taken`), of all `errors` groups.

    Where noise makes up every one of these errors, what is missing shows in all numbers together alone: then it is the
    share of the excess chi-squared.
    """
    names = ("calibrated", "extended", "noise_floor")
    rows = [row for r in errors["groups"].values() for row in zip(*(r[n] for n in names), strict=True)]
    known = np.array([row for row in rows if None not in row], float).reshape(-1, 3)
    with np.errstate(over="ignore"):
        before, after, noise = (known**2).T
    if beyond(before, noise).any():
        return taken(before, after, noise)
    whole = v.chi2("calibrated")
    return (whole - v.chi2("extended")) / max(whole - _floor(v), 1e-9)


def _rms(values: Array, where: NDArray[np.bool_]) -> float | None:
    picked = values[where & np.isfinite(values)]
    return float(np.sqrt((picked**2).mean())) if picked.size else None


def verdict(v: Verified, effects: int, generic: bool) -> str:
    """One of: nothing missing, explained, partly explained, unexplained.

    Args:
      effects: named effects that are claimed.
      generic: whether something without a name was believed beside or instead of them.
    """
    bound = null_bound(v)
    after = v.chi2("extended")
    # A tenth above the null's own 95 % bound is not worth alarming anybody: the noise level itself is not known better.
    settled = after <= 1.1 * bound
    if effects:
        return "explained" if settled and not generic else "partly explained"
    return "nothing missing" if settled and not generic else "unexplained"


def _floor(v: Verified) -> float:
    """Mean chi-squared of a perfect model."""
    return float(v.null.mean()) if len(v.null) else 1.0


def null_bound(v: Verified) -> float:
    """95 % bound of chi-squared of a perfect model.

    What a twin's clusters of blocks add to it is drawn for each by itself, so that the variance of the whole is the sum
    of theirs, and its third moment too: few twins tell these better than their few sums would.
    """
    count = len(v.null)
    if count == 0:
        return 1.0
    if count == 1:
        return float(v.null[0]) + 1.645 * 0.05
    each = v.shares.var(0, ddof=1)
    whole = max(float(each.sum()), 0.01**2)
    # Degrees of freedom of a sum of variances (Satterthwaite 1946): no fewer than those of one cluster that is all.
    freedom = (count - 1) * max(whole**2 / max(float((each**2).sum()), 1e-12 * whole**2), 1.0)
    at = float(stdtrit(freedom, 0.95))
    if count > 2:  # squares have the longer tail above (Cornish and Fisher 1938)
        third = float(((v.shares - v.shares.mean(0)) ** 3).sum()) * count / ((count - 1) * (count - 2))
        at += max(third, 0.0) / whole**1.5 * (at**2 - 1) / 6
    # Of one more draw from a population of which few have been seen.
    return float(v.null.mean()) + at * np.sqrt((1 + 1 / count) * whole)


@dataclass(frozen=True)
class Open:
    """What is left open of a fit's parameters beside what the data's noise leaves.

    Attributes:
      search: (size,) standard deviation of what the search for them leaves open.
      step: (2, size) how far below and above them the physics step may hide their values.
    """

    search: Array
    step: Array


def bounds(fitted: Fit, problem: Problem, left: Open) -> Array:
    """(2, size) 95 % bounds of a fit's parameters: the noise's to either side, the step's to the side where it errs."""
    noise = _TAIL * np.hypot(uncertainty(fitted, clusters(problem)), left.search)
    return fitted.x + left.step + np.stack([-noise, noise])


def parameter_rows(fitted: Fit, nominal: Array, within: Array) -> list[dict[str, Any]]:
    """Psi with intervals: its place in the model, estimate, 95 % bounds (2, size), and how it is known."""
    space = fitted.plant.space
    rows = []
    for i, p in enumerate(space.parameters):
        value, width, (low, high) = float(fitted.x[i]), p.high - p.low, within[:, i]
        rows.append(
            {
                "name": p.name,
                "unit": p.unit,
                "field": p.field,
                "of": list(p.of),
                "nominal": float(nominal[i]),
                "estimate": value,
                "low": float(max(p.low, low)),
                "high": float(min(p.high, high)),
                "anchored": p.anchored,
                "reason": p.reason,
                "identifiable": bool(p.anchored or (high - low) / (2 * _TAIL) < 0.25 * width / np.sqrt(12)),
                "left_prior": bool(not p.anchored and min(value - p.low, p.high - value) < 0.005 * width),
            }
        )
    return rows


def effect_rows(fitted: Fit, rounds: Sequence[Round], within: Array, shares: dict[str, float]) -> list[dict[str, Any]]:
    """Accepted effects with sentences, intervals and equivalents; 95 % bounds (2, size) of all parameters.

    A parameter that only sets a unit is `given`: its low and high are what it may be, and no interval.
    """
    at = len(fitted.plant.space)
    equivalents = {i: r.rivals(i) for r in rounds for i in r.accepted}
    rows = []
    for effect, theta in zip(fitted.plant.effects, fitted.plant.split(fitted.x)[1], strict=True):
        own = within[:, at : at + len(theta)]
        at += len(theta)
        rows.append(
            {
                "id": effect.id,
                "family": effect.family,
                "where": effect.where[0] if len(effect.where) == 1 else list(effect.where),
                "sentence": effect.say(theta, (own[1] - own[0]) / (2 * _TAIL)),
                "share_of_excess": shares.get(effect.id, 0.0),
                "equivalents": equivalents.get(effect.id, []),
                "own_values": isinstance(effect, Each),
                **({"conditions": list(effect.conditions)} if isinstance(effect, Conditioned) else {}),
                **({"settings": effect.settings} if effect.settings else {}),
                "parameters": {
                    p.name: {
                        "value": float(t),
                        "low": float(max(p.low, low)),
                        "high": float(min(p.high, high)),
                        "unit": p.unit,
                        **({"given": True} if p.given else {}),
                    }
                    for p, t, low, high in zip(effect.params, theta, *own, strict=True)
                },
            }
        )
    return rows


def nought(fitted: Fit, within: Array) -> set[str]:
    """Ids of accepted effects of which every size may be one that does nothing, by 95 % bounds (2, size)."""
    at, out = len(fitted.plant.space), set[str]()
    for effect in fitted.plant.effects:
        low, high = within[:, at : at + len(effect.params)]
        at += len(effect.params)
        sizes = [not (p.shape or p.given) for p in effect.params]
        if ((low <= effect.null) & (effect.null <= high))[sizes].all():
            out.add(effect.id)
    return out


def excess_shares(v: Verified, problem: Problem, fitted: Fit, calibrated: tuple[Plant, Array]) -> dict[str, float]:
    """Share of the excess chi-squared that comes back when each effect alone is taken out, on the verification logs."""
    measure = metric(problem, v.sigma)
    excess = max(v.chi2("calibrated") - _floor(v), 1e-9)
    shares = {}
    for effect in fitted.plant.effects:
        x = fitted.x.copy()
        at = len(fitted.plant.space)
        for e in fitted.plant.effects:
            if e is effect:
                x[at : at + len(e.params)] = e.null
            at += len(e.params)
        worse = mean_square(problem, measure.whiten(problem.residual(fitted.plant, x[None]))[0], v.most)
        shares[effect.id] = float(np.clip((worse - v.chi2("extended")) / excess, 0, 1))
    return shares


def gain_interval(v: Verified, rng: np.random.Generator) -> tuple[float, float]:
    """95 % interval of the ratio of extended to calibrated chi-squared over the verification logs."""
    blocks = clusters(v.problem)
    before, after = (v.squares(stage).sum(1) for stage in ("calibrated", "extended"))
    seed = int(rng.integers(2**31))
    ratio = bootstrap(after, blocks, np.random.default_rng(seed)) / np.maximum(
        bootstrap(before, blocks, np.random.default_rng(seed)), 1e-12
    )
    return float(np.quantile(ratio, 0.025)), float(np.quantile(ratio, 0.975))
