"""How often a score alarms: a threshold at a wanted false-positive rate, and what a detector is judged by.

A score is compared with its threshold window by window; nothing is adjusted for neighbours. F1 after point
adjustment, by which a whole stretch counts as found once one of its points is, is left out on purpose: a random score
wins it (Kim, Choi, Choi, Lee and Yoon 2022, "Towards a rigorous evaluation of time-series anomaly detection").
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaincinv
from scipy.stats import rankdata

from nfc_gym.core.errors import InputError

Array = NDArray[np.float64]
ALARMS = 3  # false alarms that the held-out windows must show: with fewer the rate is known to no factor of 2


@dataclass(frozen=True)
class Threshold:
    """From which score on a window counts as an anomaly, and what is known of its false alarms.

    Attributes:
      value: of the score.
      rate: wanted false-positive rate.
      windows: nominal windows, held out, that it was chosen from.
      low, high: between which the true rate lies with a probability of 90 %, if future windows are like those.
    """

    value: float
    rate: float
    windows: int
    low: float
    high: float


def wanted(rate: float) -> int:
    """Held-out nominal windows from which a rate can be set: 3 / rate, 3000 for 0.001.

    Raises:
      InputError: the rate is none.
    """
    if not 0 < rate < 1:
        raise InputError(f"threshold: the false-positive rate must lie between 0 and 1, got {rate:g}")
    return math.ceil(ALARMS / rate - 1e-9)


def threshold_at(scores: ArrayLike, rate: float, what: str = "windows") -> Threshold:
    """The score that nominal windows reach at a wanted rate.

    It is the k-th largest of n scores, k the whole part of rate (n + 1): if the windows are exchangeable with those to
    come, these reach it with a probability of rate at most (split conformal prediction, Vovk, Gammerman and Shafer
    2005), and the rate given these very windows is distributed as Beta(k, n + 1 - k).

    Args:
      scores: (n,) of nominal windows that nothing was fitted to.
      rate: wanted false-positive rate.
      what: is scored, in words.

    Raises:
      InputError: too few windows for that rate, or a score that is not finite.
    """
    least, found = wanted(rate), _scores("held-out nominal", scores)
    n = len(found)
    if n < least:
        enough = f"; from these a rate of {ALARMS / n:.2g} or more can be set" if n > ALARMS else ""
        raise InputError(
            f"threshold: {n} held-out {what} cannot show a false-positive rate of {rate:g}, which takes {least} or "
            f"more ({ALARMS} false alarms among them){enough}"
        )
    k = math.floor(rate * (n + 1))
    low, high = betaincinv(k, n + 1 - k, [0.05, 0.95])
    return Threshold(float(np.sort(found)[-k]), rate, n, float(low), float(high))


def auroc(nominal: ArrayLike, faulty: ArrayLike) -> tuple[float, float]:
    """Probability that a faulty window scores higher than a nominal one (ties count half), and its standard error.

    The error is that of Hanley and McNeil (1982), from both sets' sizes.
    """
    a, b = _scores("nominal", nominal), _scores("faulty", faulty)
    m, n = len(a), len(b)
    area = (rankdata(np.concatenate([a, b]))[m:].sum() - n * (n + 1) / 2) / (m * n)
    up, down = area / (2 - area), 2 * area**2 / (1 + area)
    spread = area * (1 - area) + (n - 1) * (up - area**2) + (m - 1) * (down - area**2)
    return float(area), math.sqrt(max(spread, 0.0) / (m * n))


def rate_above(scores: ArrayLike, threshold: float) -> tuple[float, float]:
    """Share of windows that reach a threshold, and its standard error (of half a window more, so that 0 has one)."""
    found = _scores("scored", scores)
    hits, n = int((found >= threshold).sum()), len(found)
    p = (hits + 0.5) / (n + 1)
    return hits / n, math.sqrt(p * (1 - p) / n)


def _scores(what: str, scores: Any) -> Array:
    found = np.asarray(scores, float)
    if found.ndim != 1 or not len(found) or np.isnan(found).any():
        raise InputError(
            f"scores of {what} windows: want one number for each, got shape {found.shape} or NaN among them"
        )
    return found
