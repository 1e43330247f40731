"""A model by a metric of its own: the noise that it expects, the slack that it needs, and its fit under both."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.box import box
from nfc_gym.measured.fit import Fit, fit
from nfc_gym.measured.metric import Metric, likeliest_slack, metric
from nfc_gym.measured.problem import Problem
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
Told = tuple[Plant, Array]  # a model, and the parameters (size,) at which it told the noise that it expects
_ROUNDS, _TURNS = 6, 2  # iterations of each fit, with the slopes at hand; fits and slacks in turns
_NEAR = 0.05  # of a parameter, within which a model expects the same noise: that is averaged over psi as far off
_FELT = 0.1  # standard deviations, root mean square, by which a parameter's move changes nothing of it either


@dataclass
class Data:
    """A problem with the noise covariance (S, m, m) that a model expects; `by` which one, where that is known."""

    problem: Problem
    sigma: Array
    by: Told | None = None

    def expected(self, by: Told) -> "Data":
        """The same with what another model expects."""
        return Data(self.problem, self.problem.covariance(*by), by)


def heard(model: Fit, before: Sequence[Told], x: Array | None = None) -> Told:
    """Where a model's noise was told before, if that was hardly elsewhere; else where it stands.

    What noise a model expects where bodies touch takes some forty roll-outs of every block. It is averaged over a few
    psi near by, so that one that has moved by less than these are off expects the same, and so does one that moves the
    motion by next to nothing: a damping that hardly shows may come to half as much in any fit.

    Args:
      model: with slopes at its parameters or near them.
      before: where noise was told.
      x: (size,) parameters that are asked about; default those of the model.
    """
    plant, x = model.plant, model.x if x is None else x
    limits, psi = box(plant), int(plant.space.free.sum())
    felt = np.sqrt((model.jacobian**2).sum((0, 1)) / max(int((model.white != 0).sum()), 1))
    for told in before:
        other, at = told
        if other.space is not plant.space or other.effects != plant.effects:
            continue
        there = limits.at(at)
        moved = np.abs(limits.at(x) - there)
        room = np.concatenate([_NEAR * np.abs(there[:psi]), np.full(len(there) - psi, _NEAR)])
        if ((moved <= room) | (felt * moved <= _FELT)).all():
            return told
    return plant, x


@dataclass(frozen=True)
class Owned:
    """A model as it is judged.

    Attributes:
      fitted: under the metrics that it is judged by.
      by: these, on the fit and on the selection logs.
      seen: the same fit under the arena's metric.
      asked: the fit that it stands for, which whoever finds it by its id must keep.
      told: where it told the noise that it expects.
    """

    fitted: Fit
    by: tuple[Metric, Metric]
    seen: Fit
    asked: Fit
    told: Told


def owned(fitted: Fit, fit_data: Data, select: Data, under: Metric, told: Told) -> Owned:
    """Fit a model on under a metric of its own.

    Args:
      fitted: the model, under the metric `under` of the fit logs.
      fit_data, select: logs that models are fitted to, and logs that they are judged on besides.
      under: what the fit is seen under in the end.
      told: where it tells the noise that it expects.
    """
    plant, sigma = fitted.plant, fit_data.expected(told).sigma
    best, by, extra = fitted, under, np.zeros(len(under.mask.T))
    for _ in range(_TURNS):
        residual = fit_data.problem.residual(plant, best.x[None])[0]
        extra = likeliest_slack(fit_data.problem, residual, sigma)
        before, by = by, metric(fit_data.problem, sigma, extra)
        best = fit(fit_data.problem, by, plant, best.x, _ROUNDS, known=by.translated(best.jacobian, before))
    on = metric(select.problem, select.expected(told).sigma, extra)
    white, slopes = (under.translated(a, by) for a in (best.white[..., None], best.jacobian))
    return Owned(best, (by, on), Fit(plant, best.x, white[..., 0], slopes), fitted, told)
