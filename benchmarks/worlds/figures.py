"""The figures of Tables II and III: returns between references, jerk, ways, and the intervals of all of them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import savgol_filter

from nfc_gym.measured.hidden import Array

# The one filter of both jerks: a cubic through 0.5 s of samples, whose second derivative at the middle is taken. Its
# gain for a second derivative falls to half at 1.9 Hz, below which a rover's body moves and above which sensors do.
WINDOW = 0.5  # s
DEGREE = 3
RESAMPLES = 2000


class Interval(NamedTuple):
    """A mean with its 95 % interval."""

    value: float
    low: float
    high: float


def smooth_second(values: Array, dt: float) -> Array:
    """Second derivative (T, k) of samples (T, k) by the fixed filter; (0, k) of a series shorter than it.

    Args:
      values: angular velocity [rad/s] for the orientation's jerk, linear velocity [m/s] for the position's.
      dt: between samples [s].
    """
    window = 2 * round(WINDOW / dt / 2) + 1
    if len(values) < window:
        return np.zeros((0, values.shape[1]))
    out = savgol_filter(values, window, DEGREE, deriv=2, delta=dt, axis=0)
    return out[window // 2 : len(values) - window // 2]  # the ends are extrapolations


def jerk(values: Array, dt: float) -> float:
    """Mean size of the second derivative; NaN of a series that is too short."""
    second = smooth_second(values, dt)
    return float(np.linalg.norm(second, axis=1).mean()) if len(second) else float("nan")


def way(places: Array) -> float:
    """Length of a way (T, k) [m]."""
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def gates_passed(places: Array, reference: Array, within: float) -> tuple[int, int]:
    """How many points of a reference are met, one after another, and at which sample the last of them was.

    Args:
      places: (T, 2) of the robot [m].
      reference: (g, 2) in the order in which they are to be met [m].
      within: distance that meets a point [m].
    """
    at = met = 0
    for gate in reference:
        near = np.flatnonzero(np.linalg.norm(places[at:] - gate, axis=1) < within)
        if not len(near):
            break
        at, met = at + int(near[0]), met + 1
    return met, at


def normalised(returns: Array, random: float, oracle: float) -> Array:
    """Returns between two references: 0 is a random policy's, 1 an oracle's that was trained in the true world."""
    return (np.asarray(returns, float) - random) / (oracle - random)


def recovered(adapted: float, before: float, oracle: float) -> float:
    """Share of what was lost, oracle minus unadapted, that adapting brought back."""
    return (adapted - before) / (oracle - before)


def running_min_max(returns: Sequence[float]) -> Array:
    """The paper's: each return between the smallest and the largest so far, (n,); NaN while those agree."""
    values = np.asarray(returns, float)
    low, high = np.minimum.accumulate(values), np.maximum.accumulate(values)
    with np.errstate(invalid="ignore"):
        return np.where(high > low, (values - low) / np.where(high > low, high - low, 1.0), np.nan)


def bootstrap(groups: Sequence[Array], rng: np.random.Generator, share: float = 0.95) -> Interval:
    """Mean over seeds of means over episodes, resampled in both: seeds first, then episodes within each.

    Args:
      groups: one array (episodes,) a seed; NaNs are left out.
      rng: of the resampling.
      share: of the interval.

    With one seed alone the interval is over its episodes, and says nothing of other seeds.
    """
    kept = [g for g in (np.asarray(g, float)[np.isfinite(g)] for g in groups) if len(g)]
    if not kept:
        return Interval(float("nan"), float("nan"), float("nan"))
    drawn = np.stack([rng.choice(g, (RESAMPLES, len(g))).mean(1) for g in kept], 1)
    seeds = rng.integers(len(kept), size=drawn.shape)
    means = np.take_along_axis(drawn, seeds, 1).mean(1)
    low, high = np.quantile(means, [(1 - share) / 2, (1 + share) / 2])
    return Interval(float(np.mean([g.mean() for g in kept])), float(low), float(high))
