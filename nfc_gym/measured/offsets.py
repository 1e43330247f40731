"""By how much one clock runs behind another, from a position and a measured rate of one motion: value and uncertainty.

With x the position, the rate is y(t) = g x'(t - tau) + c + noise: gain, offset, time shift. The peak of the correlation
of y with x' gives tau to a sample; Newton steps on the squared residual, with a cubic spline through x', give the rest.
Both are smoothed alike, which shifts neither; of a few widths the one that tells tau best is taken. The slope of noise
would make the residual's curvature too large, so that is taken from the slopes of both, whose noises have nothing in
common. The residual is neither white nor of one size: the standard deviation of tau comes from sums of its score over
blocks of time (as in Newey and West, Econometrica 55, 1987, with blocks for their kernel).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

Array = NDArray[np.float64]

LEAST = 50  # samples that both must have
WIDTHS = (1.0, 2.0, 4.0, 8.0)  # of the smoothing, in intervals of the slower signal
BLOCKS = 20  # sums that the uncertainty is taken from
TIES = 0.1  # of peaks so near to the highest, as periodic motion has, the one nearest to no offset is meant
FAR = 8  # samples from the peak, at which the Newton steps have lost it
LEAST_SHARED = 0.5  # of the shorter signal, which must overlap at the largest offset


class Offset(NamedTuple):
    """`seconds` that the rate comes after the position, standard deviation, and correlation once that is taken out."""

    seconds: float
    sd: float
    correlation: float


def clock_offset(time_x: Array, x: Array, time_y: Array, y: Array, most: float) -> Offset | None:
    """Estimate the offset of a rate against the position that it is the rate of.

    Args:
      time_x, time_y: (N,), (M,) s, increasing.
      x, y: (N, k), (M, k), position and rate, the same k components of one motion.
      most: s, the largest offset that is looked for.

    Returns:
      None where either is too short or does not move, or where no offset makes them agree.
    """
    if min(len(time_x), len(time_y)) < LEAST or min(np.ptp(x), np.ptp(y)) == 0:
        return None
    fine, slow = sorted(float(np.median(np.diff(t))) for t in (time_x, time_y))
    grid = np.arange(max(time_x[0], time_y[0]), min(time_x[-1], time_y[-1]), fine)
    if len(grid) < LEAST:
        return None
    position, rate = (
        np.stack([np.interp(grid, t, column) for column in values.T], 1) for t, values in ((time_x, x), (time_y, y))
    )
    smooth = [_smoothed(position, rate, width * slow / fine) for width in WIDTHS]
    start = _peak(*smooth[1], min(int(most / fine), int((1 - LEAST_SHARED) * len(smooth[1][0]))))
    if start is None:
        return None
    best = min((o for pair in smooth if (o := _refined(*pair, start)) is not None), key=lambda o: o.sd, default=None)
    return None if best is None else Offset(best.seconds * fine, best.sd * fine, best.correlation)


def _smoothed(position: Array, rate: Array, width: float) -> tuple[Array, Array]:
    """The position's own rate a sample, and the measured rate, (T, k), without the ends that the smoothing spoils."""
    edge = int(np.ceil(3 * width))
    inner = slice(edge, len(rate) - edge)
    return (
        gaussian_filter1d(position, width, axis=0, order=1)[inner],
        gaussian_filter1d(rate, width, axis=0)[inner],
    )


def agreement(a: Array, b: Array, most: int) -> Array:
    """(2 most + 1,) correlation of a (T, k) and b (T, k) without their means, b coming later by -most to most rows."""
    a, b = (v.reshape(len(v), -1) for v in (a, b))
    size, n = next_fast_len(2 * len(a), real=True), len(a)
    lags = np.arange(-most, most + 1)
    product = np.fft.irfft((np.fft.rfft(b, size, axis=0) * np.conj(np.fft.rfft(a, size, axis=0))).sum(1), size)[lags]
    energy = [np.concatenate([[0.0], np.cumsum((v**2).sum(1))]) for v in (a, b)]
    later, sooner = np.maximum(lags, 0), np.maximum(-lags, 0)  # b begins at `later`, a at `sooner`
    shared = (energy[0][n - later] - energy[0][sooner]) * (energy[1][n - sooner] - energy[1][later])
    return product / np.sqrt(np.maximum(shared, 1e-300))


def _peak(a: Array, b: Array, most: int) -> int | None:
    """The lag in samples, up to `most`, at which b (T, k) follows a best."""
    if len(a) < LEAST:
        return None
    lags = np.arange(-most, most + 1)
    found = agreement(_centred(a), _centred(b), most)
    inner = found[1:-1]
    peaks = 1 + np.flatnonzero((inner >= found[:-2]) & (inner >= found[2:]) & (inner > 0))
    if not peaks.size:
        return None
    high = peaks[found[peaks] >= (1 - TIES) * found[peaks].max()]
    return int(lags[high[np.abs(lags[high]).argmin()]])


def _refined(a: Array, b: Array, start: int) -> Offset | None:
    """Newton steps from `start`, all in samples; None where they leave the peak, as noise alone makes them do."""
    if len(a) < LEAST:
        return None
    signals, tau = _Signals(a, b), float(start)
    fit = signals.at(tau)
    for _ in range(20):
        if fit is None or abs(tau - start) > FAR:
            return None
        move = float(fit.score.sum()) / fit.curvature
        tau += float(np.clip(move, -1, 1))
        if abs(move) < 1e-4:
            break
        fit = signals.at(tau)
    if fit is None:
        return None
    sums = np.array([part.sum() for part in np.array_split(fit.score, BLOCKS)])
    return Offset(tau, float(np.sqrt((sums**2).sum() * BLOCKS / (BLOCKS - 1))) / fit.curvature, fit.correlation)


class _Fit(NamedTuple):
    """At one offset: (T,) shares of the squared residual's slope, its curvature, and the signals' correlation."""

    score: Array
    curvature: float
    correlation: float


class _Signals:
    """Two sampled signals (T, k), the first of them movable."""

    def __init__(self, a: Array, b: Array) -> None:
        rows = np.arange(len(a))
        self.curve, self.b = CubicSpline(rows, a), b
        self.slope, self.b_slope = self.curve.derivative(), CubicSpline(rows, b)(rows, 1)

    def at(self, tau: float) -> _Fit | None:
        """Fit of gain and offset at tau samples; None where they do not agree there."""
        rows = np.arange(len(self.b))
        rows = rows[(rows >= tau) & (rows - tau <= len(rows) - 1)]
        if len(rows) < LEAST:
            return None
        x, y = _centred(self.curve(rows - tau)), _centred(self.b[rows])
        gain = float((x * y).sum() / (x**2).sum())
        push = _beside(x, _centred(-gain * self.slope(rows - tau)))
        curvature = float((push * _beside(x, _centred(-self.b_slope[rows]))).sum())
        if gain <= 0 or curvature <= 0:
            return None
        correlation = float((x * y).sum() / np.sqrt((x**2).sum() * (y**2).sum()))
        return _Fit((push * (y - gain * x)).sum(1), curvature, correlation)


def _centred(values: Array) -> Array:
    return values - values.mean(0)


def _beside(x: Array, values: Array) -> Array:
    """What of `values` is not along `x`: a gain must not pass for an offset."""
    return values - x * ((values * x).sum() / (x**2).sum())
