"""What is measured of posteriors, on plain arrays: u in [0, 1], draws (windows, n, d), truths (windows, d).

Every figure is a mean over windows with its standard error; draws of one window are one piece of evidence, not n.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

Array = NDArray[np.float64]
EDGE = 1e-6


class Mean(NamedTuple):
    """A mean over windows and its standard error."""

    value: float
    error: float

    def __str__(self) -> str:
        return f"{self.value:.3f} ± {self.error:.3f}"


def mean(values: Array) -> Mean:
    """Over the first axis, one number a window; the error is nan where there is one window only."""
    values = np.asarray(values, float)
    error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
    return Mean(float(values.mean()), float(error))


def marginal_gain(draws: Array, truth: Array) -> Array:
    """(windows, d) nats told about each parameter by itself: log score of a normal fitted to its draws
    in z = probit(u).

    The prior is N(0, 1) in z and scores 0. Draws are no density: what is not normal in z is lost, and a posterior that
    is the prior comes out 1 / n below 0, so this is a little too low, alike for every method.
    """
    z, at = ndtri(np.clip(draws, EDGE, 1 - EDGE)), ndtri(np.clip(truth, EDGE, 1 - EDGE))
    middle, spread = z.mean(1), np.maximum(z.std(1, ddof=1), 1e-6)
    return (at**2 - ((at - middle) / spread) ** 2) / 2 - np.log(spread)


def intervals(draws: Array, level: float) -> tuple[Array, Array]:
    """Highest-density intervals (low, high), (windows, d) each, in u.

    The shortest interval among draws is too short, for it is the best of many. So half of the draws choose which
    quantiles are its ends, and the ends are those quantiles of the other half: its coverage is the level, to the
    rounding of 1 / (n / 2 + 1), if the posterior is right. Ends may be those of the box.
    """
    return shortest(*halved(draws), level)


def halved(draws: Array) -> tuple[Array, Array]:
    """Two halves of the draws, each sorted between the box's edges, from which intervals of every level are taken."""
    half = draws.shape[1] // 2
    choose, take = (np.sort(_edged(draws[:, i * half : (i + 1) * half]), axis=1) for i in (0, 1))
    return choose, take


def shortest(choose: Array, take: Array, level: float) -> tuple[Array, Array]:
    """`intervals` of a level, from the two halves of `halved`."""
    inside = round(level * (choose.shape[1] - 1))
    at = (choose[:, inside:] - choose[:, :-inside]).argmin(1)[:, None]
    low, high = np.take_along_axis(take, at, 1), np.take_along_axis(take, at + inside, 1)
    return low[:, 0], high[:, 0]


def _edged(draws: Array) -> Array:
    edge = np.zeros((len(draws), 1, draws.shape[2]))
    return np.concatenate([edge, draws, edge + 1], 1)


def coverage(draws: Array, truth: Array, level: float) -> Array:
    """(windows,) share of the parameters whose highest-density interval holds the truth."""
    return held(*intervals(draws, level), truth)


def held(low: Array, high: Array, truth: Array) -> Array:
    """(windows,) share of the parameters whose interval holds the truth."""
    return ((low <= truth) & (truth <= high)).mean(1)


def ranks(draws: Array, truth: Array) -> Array:
    """(windows, d) share of the draws below the truth: uniform if the posterior is right (SBC)."""
    return (draws < truth[:, None]).mean(1)


def farthest(shares: Array) -> float:
    """Largest distance between the distribution of some numbers in [0, 1] and the uniform one (Kolmogorov, Smirnov)."""
    x, n = np.sort(shares), len(shares)
    steps = np.arange(n + 1) / n
    return float(max((steps[1:] - x).max(), (x - steps[:-1]).max()))


def tarp(draws: Array, truth: Array, rng: np.random.Generator) -> Array:
    """(windows,) share of draws nearer to a random point than the truth is: uniform if the joint posterior is right.

    Lemos et al. 2023, "Sampling-based accuracy testing of posterior estimators".
    """
    point = rng.uniform(size=truth.shape)
    near = np.linalg.norm(draws - point[:, None], axis=2) < np.linalg.norm(truth - point, axis=1)[:, None]
    return near.mean(1)


def energy_score(draws: Array, truth: Array) -> Array:
    """(windows,) E|X - truth| - E|X - X'| / 2, Gneiting and Raftery 2007; lower is better, X = truth is 0."""
    n = draws.shape[1]
    away = np.linalg.norm(draws - truth[:, None], axis=2).mean(1)
    apart = np.array([_apart(d) for d in draws])
    return away - apart / (2 * n * (n - 1))


def _apart(draws: Array) -> float:
    """Sum of the distances between all ordered pairs of draws (n, d)."""
    squares = (draws**2).sum(1)
    inner = squares[:, None] + squares - 2 * draws @ draws.T
    np.fill_diagonal(inner, 0)
    return float(np.sqrt(np.maximum(inner, 0)).sum())


def variogram_score(draws: Array, truth: Array, lags: tuple[int, ...] = (1, 2, 4, 8, 16)) -> Array:
    """(windows,) squared misfit of |m_i - m_j|^(1/2) between maps (windows, n, k, k) and their truth (windows, k, k).

    Scheuerer and Hamill 2015, of order 1/2; of all pairs of cells those `lags` apart along a row or a column, each lag
    as heavy. It sees wrong correlations, which the energy score hardly does.
    """
    out = np.zeros(len(truth))
    for axis in (1, 2):
        for lag in lags:
            steps = np.sqrt(np.abs(_shifted(draws, axis + 1, lag)))
            out += ((np.sqrt(np.abs(_shifted(truth, axis, lag))) - steps.mean(1)) ** 2).mean((1, 2))
    return out / (2 * len(lags))


def _shifted(maps: Array, axis: int, lag: int) -> Array:
    size = maps.shape[axis]
    return maps.take(range(lag, size), axis) - maps.take(range(size - lag), axis)


def spectrum(maps: Array) -> Array:
    """(..., octaves) mean power of maps (..., k, k) in octaves of the wave number, the longest waves first.

    The mean is taken out and a Hann window laid over the map, so that its edges do not look like steps.
    """
    k = maps.shape[-1]
    window = np.hanning(k)
    seen = (maps - maps.mean((-2, -1), keepdims=True)) * np.outer(window, window)
    power = np.abs(np.fft.fft2(seen)) ** 2 / k**2
    wave = np.hypot(*np.meshgrid(np.fft.fftfreq(k, 1 / k), np.fft.fftfreq(k, 1 / k)))
    octave = np.floor(np.log2(np.maximum(wave, 0.5))).astype(int)
    top = int(np.log2(k // 2))
    return np.stack([power[..., octave == o].mean(-1) for o in range(top)], -1)


def area(scores: Array, positive: NDArray[np.bool_]) -> float:
    """Area under the curve: the chance that a positive scores higher than a negative, ties counting half."""
    order = np.argsort(scores, kind="stable")
    x = scores[order]
    starts = np.r_[0, np.flatnonzero(np.diff(x)) + 1, len(x)]
    rank = np.repeat((starts[:-1] + starts[1:] + 1) / 2, np.diff(starts))
    of = np.empty(len(x))
    of[order] = rank
    n, m = positive.sum(), (~positive).sum()
    return float((of[positive].sum() - n * (n + 1) / 2) / (n * m)) if n and m else float("nan")


def normal_like(draws: Array, n: int, rng: np.random.Generator) -> Array:
    """(windows, n, d) draws of a normal with the mean and covariance of other draws (windows, m, d), m > 1.

    Written as weighted sums of the draws' deviations, so that no covariance of d x d is made.
    """
    m = draws.shape[1]
    middle = draws.mean(1, keepdims=True)
    weight = rng.standard_normal((len(draws), n, m)) / np.sqrt(m - 1)
    return middle + weight @ (draws - middle)
