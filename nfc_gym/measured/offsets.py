"""By how much one clock runs behind another, from two measurements of the same motion: value, uncertainty, agreement.

Both are taken for the same signal but for a gain, an offset and the time shift tau: b(t) = g a(t - tau) + c + noise. The
peak of their cross-correlation gives tau to a sample; Newton steps on the squared residual, with a cubic spline through
a, give the rest. Both are smoothed alike, which shifts neither; of a few widths the one that tells tau best is taken. The
slope of noise would make the curvature of the residual too large, so that is taken from both signals' slopes, whose
noises have nothing in common. The residual is neither white nor of one size: the standard deviation of tau comes from
the sums of its score over blocks of time (as in Newey and West, Econometrica 55, 1987, with blocks for their kernel).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

Array = NDArray[np.float64]

LEAST = 50  # samples that both must have
WIDTHS = (1.0, 2.0, 4.0, 8.0)  # of the smoothing, in intervals of the slower signal
BLOCKS = 20  # sums that the uncertainty is taken from
TIES = 0.01  # of peaks so near to the highest, as periodic motion has, the one nearest to no offset is meant


class Offset(NamedTuple):
    """`seconds` that b comes after a, its standard deviation, and their correlation once it is taken out."""

    seconds: float
    sd: float
    correlation: float


def clock_offset(time_a: Array, a: Array, time_b: Array, b: Array, most: float) -> Offset | None:
    """Estimate the offset of b against a.

    Args:
      time_a, time_b: (N,), (M,) s, increasing.
      a, b: (N, k), (M, k), the same k components of one motion.
      most: s, the largest offset that is looked for.

    Returns:
      None where either is too short or does not move, or where no offset makes them agree.
    """
    if min(len(time_a), len(time_b)) < LEAST or min(np.ptp(a), np.ptp(b)) == 0:
        return None
    fine, slow = sorted(float(np.median(np.diff(t))) for t in (time_a, time_b))
    grid = np.arange(max(time_a[0], time_b[0]), min(time_a[-1], time_b[-1]), fine)
    if len(grid) < LEAST:
        return None
    x, y = (
        np.stack([np.interp(grid, t, column) for column in (values - values.mean(0)).T], 1)
        for t, values in ((time_a, a), (time_b, b))
    )
    start = _peak(x, y, min(int(most / fine), len(grid) // 2))
    if start is None:
        return None
    found = [_refined(x, y, start, width * slow / fine) for width in WIDTHS]
    best = min((o for o in found if o is not None), key=lambda o: o.sd, default=None)
    return None if best is None else Offset(best.seconds * fine, best.sd * fine, best.correlation)


def _peak(x: Array, y: Array, most: int) -> int | None:
    """The lag in samples, up to `most`, at which the two signals (T, k) agree best."""
    size = next_fast_len(2 * len(x), real=True)
    product = irfft((rfft(y, size, axis=0) * np.conj(rfft(x, size, axis=0))).sum(1), size)
    lags = np.arange(-most, most + 1)
    shared = product[lags] * len(x) / (len(x) - np.abs(lags))
    inner = shared[1:-1]
    peaks = 1 + np.flatnonzero((inner >= shared[:-2]) & (inner >= shared[2:]) & (inner > 0))
    if not peaks.size:
        return None
    high = peaks[shared[peaks] >= (1 - TIES) * shared[peaks].max()]
    return int(lags[high[np.abs(lags[high]).argmin()]])


def _refined(x: Array, y: Array, start: int, width: float) -> Offset | None:
    """Newton steps from `start`, all in samples; None where they leave the peak, as noise alone makes them do."""
    edge = int(np.ceil(3 * width))
    row = np.arange(len(x))[edge : len(x) - edge]
    if len(row) < LEAST:
        return None
    curve, other = (CubicSpline(np.arange(len(x)), gaussian_filter1d(v, width, axis=0)) for v in (x, y))
    tau = float(start)
    for _ in range(20):
        at = row[(row - tau >= row[0]) & (row - tau <= row[-1])]
        if len(at) < LEAST:
            return None
        a, b = _centred(curve(at - tau)), _centred(other(at))
        gain = float((a * b).sum() / (a**2).sum())
        push = _beside(a, _centred(-gain * curve(at - tau, 1)))
        size = float((push * _beside(a, _centred(-other(at, 1)))).sum())
        rest = b - gain * a
        if gain <= 0 or size <= 0:
            return None
        move = float((push * rest).sum()) / size
        tau += float(np.clip(move, -1, 1))
        if abs(tau - start) > 4 + width:
            return None
        if abs(move) < 1e-6:
            break
    sums = np.array([part.sum() for part in np.array_split((push * rest).sum(1), BLOCKS)])
    correlation = float((a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum()))
    return Offset(tau, float(np.sqrt((sums**2).sum() * BLOCKS / (BLOCKS - 1))) / size, correlation)


def _centred(values: Array) -> Array:
    return values - values.mean(0)


def _beside(a: Array, values: Array) -> Array:
    """What of `values` is not along `a`: a gain must not pass for an offset."""
    return values - a * ((values * a).sum() / (a**2).sum())
