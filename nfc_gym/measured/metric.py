"""Whitening and loss: how large a residual is, given the noise to be expected and what no model so far explains."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.problem import Problem

Array = NDArray[np.float64]
_UNSTABLE = 30.0  # standard deviations that every number of an unstable block counts as
_SEEN = 0.64  # of a squared error: where noise makes up more of it, the error is not counted
_NOTHING = 0.05  # of the noise's variance: a squared error that exceeds it by less counts as taken away whole
_SHARES = (0.0, *10.0 ** np.arange(-5, 2))  # of the errors' variance, among which slack is looked for
_PAST = 2  # of them in a row that do no better, after which no more is looked for
_EXACT = 1e-4  # share of it to which an excess variance is found
_TURN = 3.0  # standard deviations at which the loss turns from squared to linear


@dataclass(frozen=True)
class Metric:
    """Whitening of a problem's residuals.

    Attributes:
      inverse_root: (S, m, m) lower triangular, maps a block's residual to unit variance.
      mask: (S, m) which numbers count.
    """

    inverse_root: Array
    mask: NDArray[np.bool_]

    def whiten(self, residual: Array) -> Array:
        """(P, S, m) residuals in standard deviations; unstable blocks count as far off."""
        white = np.einsum("sij,psj->psi", self.inverse_root, np.where(np.isfinite(residual), residual, 0.0))
        bad = ~np.isfinite(residual).all(-1, keepdims=True)
        return np.where(self.mask, np.where(bad, _UNSTABLE, white), 0.0)

    def surprise(self, residual: Array) -> Array:
        """(P, S) twice the negative log-likelihood of residuals (P, S, m), but for a constant: loss and log-volume.

        By this, models can be compared that expect noise of different size: who expects more must pay for it.
        """
        log_det = -2 * np.log(np.einsum("sii->si", self.inverse_root)).sum(1)
        return loss(self.whiten(residual)) + log_det

    def translated(self, white: Array, other: "Metric") -> Array:
        """What another metric of the same problem whitened, (S, m, n) columns, as this one has it."""
        return self.inverse_root @ np.linalg.solve(other.inverse_root, white)

    def take(self, index: NDArray[np.intp]) -> "Metric":
        """The metric of some of the blocks."""
        return Metric(self.inverse_root[index], self.mask[index])


def taken(before: Array, after: Array, noise: Array) -> float:
    """Share of mean squared errors (k,) beyond the noise (k,) that one model takes away of what another leaves.

    The geometric mean over those that the noise does not make up alone; 1 where it makes up all.
    Chi-squared will not do: where sensors are far better than any model, it is the same great number before and after.
    """
    shows = beyond(before, noise)
    before, after, noise = before[shows], after[shows], noise[shows]
    with np.errstate(over="ignore"):  # a model that runs away takes nothing away
        left = np.maximum(after - noise, np.maximum(_NOTHING * noise, 1e-12 * before)) / (before - noise)
        return 1 - float(np.exp(np.log(left).mean())) if shows.any() else 1.0


def beyond(error: Array, noise: Array) -> NDArray[np.bool_]:
    """(k,) mean squared errors that the noise does not make up alone."""
    return noise < _SEEN * error


def unexplained_variance(problem: Problem, residual: Array, sigma: Array) -> Array:
    """(m,) variance of each kind of column (quantity, place, horizon) beyond what the noise explains.

    It comes from the spread of the residuals, each by the noise of its own block; residual (S, m) and sigma (S, m, m)
    are those of the best model so far. Candidates of one round are compared under one such variance, so that no model
    is flattered by a metric of its own.
    """
    values = np.where(problem.mask & np.isfinite(residual), residual, np.nan)
    expected = np.where(problem.mask, np.einsum("sii->si", sigma), np.nan)
    out = np.zeros(len(problem.columns))
    for of in _kinds(problem):
        there = np.isfinite(values[:, of])
        if not there.any():
            continue
        errors, known = values[:, of][there], expected[:, of][there]
        # Where bodies touch, some blocks are far out for reasons of their own, and others expect landings to err more
        # than any does; neither may buy all the others slack, and the middle of both is asked.
        out[of] = max(_spread(errors) - np.median(known), 0.0) if problem.rough else _excess(errors, known)
    return out


def _excess(errors: Array, known: Array) -> float:
    """Variance, equal for all, that errors (n,) need beside the variances (n,) known of each to be of unit size.

    Blocks of one log may differ a hundredfold in what noise they expect, as a fast motion does in what its start and
    the step make of it. The mean square of their errors is then far above the middle of what is expected, though the
    noise explains every one of them; and slack for that would hide what the precise blocks tell.
    """
    low, high = 0.0, _size(errors)
    if _size(errors / np.sqrt(np.maximum(known, 1e-300))) <= 1:
        return 0.0
    while high - low > _EXACT * high:
        middle = (low + high) / 2
        low, high = (middle, high) if _size(errors / np.sqrt(known + middle)) > 1 else (low, middle)
    return high


def _size(errors: Array) -> float:
    """Variance of errors (n,) by the middle of their spread, or by all of them, those far out as three deviations."""
    spread = _spread(errors)
    return max(spread, float(np.minimum(errors**2, 9 * spread if spread > 0 else np.inf).mean()))


def likeliest_slack(problem: Problem, residual: Array, sigma: Array) -> Array:
    """(m,) slack by which a model's own errors are the likeliest: that of each kind of column, and some in all of them.

    Noise that is carried through a roll-out goes the same way at all horizons. An error of its size may be impossible
    across that way, of which no column by itself tells; and without slack there a model that mends half of the errors,
    and so expects less noise, would be thought the worse for it.

    Args:
      residual: (S, m) of the model.
      sigma: (S, m, m) covariance of the noise that it expects.
    """
    values = np.where(problem.mask & np.isfinite(residual), residual, np.nan)
    least, spread = unexplained_variance(problem, residual, sigma), np.zeros(len(problem.columns))
    for of in _kinds(problem):
        if np.isfinite(values[:, of]).any():
            spread[of] = _spread(values[:, of])
    best, lowest, past = least, np.inf, 0
    for share in _SHARES:
        extra = least + share * spread
        surprise = float(metric(problem, sigma, extra).surprise(residual[None]).sum())
        if surprise < lowest:
            best, lowest, past = extra, surprise, 0
        elif (past := past + 1) == _PAST:
            break
    return best


def _kinds(problem: Problem) -> list[NDArray[np.bool_]]:
    """(m,) which columns are of each kind: one quantity at one place and one horizon."""
    c = problem.columns
    kinds = list(zip(c.group, c.place, c.horizon.tolist(), strict=True))
    return [np.array([k == kind for k in kinds]) for kind in dict.fromkeys(kinds)]


def _spread(errors: Array) -> float:
    """Variance by the middle of errors' spread; NaN are none."""
    return float(1.4826 * np.nanmedian(np.abs(errors))) ** 2


def metric(problem: Problem, sigma: Array, extra: Array | None = None) -> Metric:
    """Metric of covariance sigma (S, m, m), plus independent variance `extra` (m,) of each column."""
    width = sigma.shape[-1]
    total = sigma.copy()
    if extra is not None:
        total[:, np.arange(width), np.arange(width)] += extra
    masked = ~problem.mask
    total = np.where(masked[:, :, None] | masked[:, None, :], 0.0, total)
    diagonal = np.einsum("sii->si", total)
    typical = np.where(masked, 1.0, np.maximum(diagonal, 1e-18))
    scale = np.sqrt(typical)
    unit = total / scale[:, :, None] / scale[:, None, :]
    unit[:, np.arange(width), np.arange(width)] = np.where(masked, 1.0, 1.0 + 1e-6)
    root = np.linalg.cholesky(unit)
    inverse = np.linalg.inv(root) / scale[:, None, :]
    return Metric(inverse, problem.mask)


def loss(white: Array) -> Array:
    """(..., S) loss of whitened residuals (..., S, m): squared near zero, linear far out (Huber's idea, smooth)."""
    return (2 * _TURN**2 * (np.sqrt(1 + (white / _TURN) ** 2) - 1)).sum(-1)


def loss_weight(white: Array) -> Array:
    """Square root of the weight that the loss gives each residual in a linearised fit."""
    return (1 + (white / _TURN) ** 2) ** -0.25


TURN = _TURN
