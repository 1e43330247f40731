"""Which of several fitted candidates to believe: gains on logs not fitted to, under a moving-block bootstrap."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.box import box
from nfc_gym.measured.fit import Fit
from nfc_gym.measured.metric import Metric, loss, loss_weight
from nfc_gym.measured.problem import Problem
from nfc_gym.physics.effects.base import Effect

Array = NDArray[np.float64]
_DAMPING = 0.03


def clusters(problem: Problem, seconds: float = 0.5) -> NDArray[np.intp]:
    """(S,) cluster of each block: blocks of one log within `seconds` of each other are not independent."""
    keys = np.stack([problem.log_of, np.floor(problem.time_of / seconds)], 1)
    return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)


def bootstrap(values: Array, blocks: NDArray[np.intp], rng: np.random.Generator, draws: int = 2000) -> Array:
    """(draws,) sums of per-block values (S,) over clusters drawn with replacement."""
    sums = np.bincount(blocks, values)
    picks = rng.integers(len(sums), size=(draws, len(sums)))
    return sums[picks].sum(1)


def calmed(gains: Array, numbers: NDArray[np.intp]) -> Array:
    """(S,) gains of blocks, those beyond one for each number counted by their logarithm.

    Where bodies touch, a foot that lands a moment earlier throws a whole block off, and one such block outweighs all
    others: a bootstrap of the plain sums then says only whether that block was drawn. A limit that eight blocks in
    seventy reach gains in each of them and hardly loses elsewhere, and should be seen.

    Args:
      gains: (S,).
      numbers: (S,) that are compared in each block.
    """
    scale = np.maximum(numbers, 1)
    return np.asarray(scale * np.arcsinh(gains / scale), np.float64)


@dataclass(frozen=True)
class Judged:
    """A fitted candidate and how it did.

    Attributes:
      fitted: on the fit logs.
      gains: (S,) drop of the surprise (`Metric`) per block of the selection logs against the model without it.
      fit_gains: the same on the fit logs, each group of blocks predicted by a fit that left it out.
      total: drop over both, less a price for each parameter (the Bayesian information criterion, Schwarz 1978).
      lower: 0.5 % bootstrap quantile of the gain over both; where bodies touch, of the calmed gains (`calmed`).
    """

    fitted: Fit
    gains: Array
    fit_gains: Array
    total: float
    lower: float

    @property
    def gain(self) -> float:
        """Drop of the surprise over the selection logs."""
        return float(self.gains.sum())

    @property
    def drop(self) -> float:
        """Drop of the surprise over both sets of logs, whatever the parameters cost."""
        return float(self.gains.sum()) + float(self.fit_gains.sum())


def mean(judged: Sequence[Judged]) -> Judged:
    """One candidate as several metrics judge it, in the mean."""
    gains, fit_gains = (np.mean([getattr(j, name) for j in judged], 0) for name in ("gains", "fit_gains"))
    total, lower = (float(np.mean([getattr(j, name) for j in judged])) for name in ("total", "lower"))
    return Judged(judged[0].fitted, gains, fit_gains, total, lower)


def losses(problem: Problem, metric: Metric, fitted: Fit) -> Array:
    """(S,) loss of each block of a problem under a fitted model."""
    return loss(metric.whiten(fitted_residual(problem, fitted)))[0]


def fitted_residual(problem: Problem, fitted: Fit) -> Array:
    """(1, S, m) residual under a fitted model."""
    return problem.residual(fitted.plant, fitted.x[None])


@dataclass(frozen=True)
class Side:
    """The logs that candidates are fitted to, or those that they are judged on besides.

    Attributes:
      problem: of these logs.
      blocks: (S,) clusters of its blocks.
      base: (S,) surprise of each block under the model to beat; of fit logs, when the block is left out of the fit.
    """

    problem: Problem
    blocks: NDArray[np.intp]
    base: Array


def judge(
    fitted: Fit,
    base: Fit,
    metrics: tuple[Metric, Metric],
    sides: tuple[Side, Side],
    folds: NDArray[np.intp],
    rng: np.random.Generator,
) -> Judged:
    """Compare a fitted candidate with the model without it.

    Args:
      fitted, base: the candidate and the model to beat.
      metrics: by which the candidate's errors count on the fit and on the selection logs.
      sides: these logs.
      folds: (S,) fold of each block of the fit logs.
      rng: of the bootstrap.
    """
    fit_side, select = sides
    gains = select.base - metrics[1].surprise(fitted_residual(select.problem, fitted))[0]
    fit_gains = fit_side.base - left_out(fit_side.problem, metrics[0], fitted, folds)
    extra = len(fitted.x) - len(base.x)
    both = np.concatenate([gains, fit_gains])
    blocks = np.concatenate([select.blocks, fit_side.blocks + int(select.blocks.max()) + 1])
    numbers = np.concatenate([s.problem.mask.sum(1) for s in (select, fit_side)])
    draws = bootstrap(calmed(both, numbers) if fit_side.problem.rough else both, blocks, rng)
    count = int(numbers.sum())
    total = float(both.sum()) - price(count, extra, dispersion(base))
    return Judged(fitted, gains, fit_gains, total, float(np.quantile(draws, 0.005)))


def price(count: int, extra: int, dispersion: float) -> float:
    """Schwarz's price (1978) of parameters: which law is at work is asked, and not only which predicts best.

    Args:
      count: numbers that are compared.
      extra: parameters that the candidate adds.
      dispersion: loss per number of the model without it.
    """
    return float(np.log(max(count, 2)) * extra * dispersion)


def left_out(problem: Problem, by: Metric, fitted: Fit, folds: NDArray[np.intp]) -> Array:
    """(S,) surprise of each block when its fold takes no part in the fit: one Gauss-Newton step from the whole fit.

    At the optimum the blocks' gradients add up to zero; without fold k they add up to minus its own, and the parameters
    move by H_-k^{-1} g_k. The residuals there, of each block where its own fold is left out, count as `by` has it.
    """
    jac, white = fitted.jacobian, fitted.white
    if jac.shape[-1] == 0:
        return by.surprise(fitted_residual(problem, fitted))[0]
    weight = loss_weight(white) ** 2
    limits = box(fitted.plant)
    hessians = np.einsum("smi,sm,smj->sij", jac, weight, jac)
    gradients = np.einsum("smi,sm->si", jac, weight * white)
    whole = hessians.sum(0) + np.diag(limits.pull**2)
    # Damped as in a Levenberg-Marquardt step: where the other folds say nothing, the linear model must not run away.
    ridge = _DAMPING * np.diag(np.diag(whole)) + 1e-12 * np.eye(len(whole))
    names = np.unique(folds)
    z = np.repeat(limits.at(fitted.x)[None], len(names), 0)
    for row, k in zip(z, names, strict=True):
        of = folds == k
        row += np.linalg.solve(whole - hessians[of].sum(0) + ridge, gradients[of].sum(0))
    outside = limits.x(z, fitted.x)[np.searchsorted(names, folds)]
    return by.surprise(problem.each(fitted.plant, outside)[None])[0]


def fold_of(problem: Problem, most: int = 8) -> NDArray[np.intp]:
    """(S,) fold of each block for leaving out: its log where there are several, else a stretch of the log."""
    logs = np.unique(problem.log_of, return_inverse=True)[1].reshape(-1)
    if logs.max() >= 3:
        return logs % most if logs.max() >= most else logs
    order = np.lexsort((problem.time_of, problem.log_of))
    out = np.empty(len(problem), np.intp)
    out[order] = np.arange(len(problem)) * most // len(problem)
    return out


def dispersion(fitted: Fit) -> float:
    """Loss per number that counts: about 1 where the metric fits the residual, the natural unit of a chance gain."""
    count = max(int((fitted.white != 0).sum()), 1)
    return max(float(fitted.losses.sum()) / count, 1e-6)


def not_worse(
    best: Judged,
    other: Judged,
    blocks_fit: NDArray[np.intp],
    blocks_select: NDArray[np.intp],
    rng: np.random.Generator,
    *,
    priced: bool = True,
) -> bool:
    """Whether `other` explains the data not significantly worse than `best` (2.5 % level, both sets of logs).

    Args:
      best, other: what is compared.
      blocks_fit, blocks_select: clusters of blocks, see `clusters`.
      rng: of the bootstrap.
      priced: whether parameters have their price, as in the choice of a law. What the data cannot exclude is another
        question, and a push along three axes is not excluded by a floor that leans about two.
    """
    apart = np.concatenate([best.fit_gains - other.fit_gains, best.gains - other.gains])
    blocks = np.concatenate([blocks_fit, blocks_select + int(blocks_fit.max()) + 1])
    penalty = best.total - other.total - float(apart.sum()) if priced else 0.0
    draws = bootstrap(apart, blocks, rng) + penalty
    return bool(np.quantile(draws, 0.025) <= 0)


def mechanism(effect: Effect) -> tuple[str, frozenset[str]]:
    """The plainest law that an effect starts from, and its place: what friction in all its dresses has in common."""
    return (effect.simpler[0][0] if effect.simpler else effect.family), frozenset(effect.where)


def shortlist(screened: Sequence, size: int = 8, each: int = 2) -> list:
    """The best candidates, at most `each` of one family, and as many that start from the same law at the same place.

    Otherwise one family's places, or friction in four dresses, would crowd out all other mechanisms.
    """
    out, count = [], Counter()
    for s in screened:
        effect = s.effect
        keys = (effect.family, mechanism(effect))
        if s.gain <= 0 or any(count[k] >= each for k in keys):
            continue
        count.update(keys)
        out.append(s)
        if len(out) == size:
            break
    return out
