"""A model by a metric of its own: the noise that it expects, the slack that it needs, and its fit under both."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.fit import Fit, fit
from nfc_gym.measured.metric import Metric, likeliest_slack, metric
from nfc_gym.measured.problem import Problem

Array = NDArray[np.float64]
_ROUNDS, _TURNS = 6, 2  # iterations of each fit, with the slopes at hand; fits and slacks in turns


@dataclass
class Data:
    """A problem with the noise covariance (S, m, m) that a model expects."""

    problem: Problem
    sigma: Array

    def expected(self, by: Fit) -> "Data":
        """The same with what another model expects."""
        return Data(self.problem, self.problem.covariance(by.plant, by.x))


@dataclass(frozen=True)
class Owned:
    """A model as it is judged.

    Attributes:
      fitted: under the metrics that it is judged by.
      by: these, on the fit and on the selection logs.
      seen: the same fit under the arena's metric.
      asked: the fit that it stands for, which whoever finds it by its id must keep.
    """

    fitted: Fit
    by: tuple[Metric, Metric]
    seen: Fit
    asked: Fit


def owned(fitted: Fit, fit_data: Data, select: Data, under: Metric) -> Owned:
    """Fit a model on under a metric of its own.

    Args:
      fitted: the model, under the metric `under` of the fit logs.
      fit_data, select: logs that models are fitted to, and logs that they are judged on besides.
      under: what the fit is seen under in the end.
    """
    plant, sigma = fitted.plant, fit_data.expected(fitted).sigma
    best, by, extra = fitted, under, np.zeros(len(under.mask.T))
    for _ in range(_TURNS):
        residual = fit_data.problem.residual(plant, best.x[None])[0]
        extra = likeliest_slack(fit_data.problem, residual, sigma)
        before, by = by, metric(fit_data.problem, sigma, extra)
        best = fit(fit_data.problem, by, plant, best.x, _ROUNDS, known=by.translated(best.jacobian, before))
    on = metric(select.problem, select.expected(fitted).sigma, extra)
    white, slopes = (under.translated(a, by) for a in (best.white[..., None], best.jacobian))
    return Owned(best, (by, on), Fit(plant, best.x, white[..., 0], slopes), fitted)
