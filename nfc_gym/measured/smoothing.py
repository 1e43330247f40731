"""Local polynomial regression of a sampled signal: value, slope, curvature, their noise gain; noise level; means."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
POINTS = 7  # samples in each local fit that tells a state


@dataclass(frozen=True)
class Local:
    """A local polynomial at the wanted times, T of them, of a signal with k columns.

    Attributes:
      value, slope, curvature: (T, k), in the unit, unit/s and unit/s^2.
      value_gain, slope_gain: (T,) standard deviation of value and slope for unit noise on the samples.
      misfit: (T,) by how much the samples are off the polynomial, root mean square over the columns, as an estimate of
        the noise without bias; 0 where the polynomial has as many coefficients as there are samples.
    """

    value: Array
    slope: Array
    curvature: Array
    value_gain: Array
    slope_gain: Array
    misfit: Array


def local_polynomial(time: Array, values: Array, at: Array, points: int = POINTS, degree: int = 3) -> Local:
    """Fit a polynomial to the `points` samples nearest each time of `at`.

    Args:
      time: (N,) s, increasing.
      values: (N, k).
      at: (T,) s.
      points: samples in each fit; fewer where the signal is shorter.
      degree: of the polynomial, lowered to leave at least one sample more than coefficients.
    """
    points = min(points, len(time))
    degree = max(min(degree, points - 2), 0)
    middle = np.searchsorted(time, at)
    first = np.clip(middle - points // 2, 0, len(time) - points)
    window = first[:, None] + np.arange(points)
    span = np.maximum(time[window[:, -1]] - time[window[:, 0]], 1e-12)
    scaled = (time[window] - at[:, None]) / span[:, None]
    alike, of = _alike(scaled)  # of samples at even times few differ
    basis = alike[..., None] ** np.arange(degree + 1)
    solve = np.linalg.pinv(basis)  # (kinds, degree + 1, points)
    gain = np.linalg.norm(solve, axis=-1)[of]
    basis, fitted = basis[of], solve[of] @ values[window]
    rows = [fitted[:, i] if i <= degree else np.zeros_like(fitted[:, 0]) for i in range(3)]
    slope_gain = gain[:, 1] / span if degree >= 1 else np.zeros(len(at))
    off = np.square(values[window] - basis @ fitted).mean(-1).sum(-1) / max(points - degree - 1, 1)
    bend = 2 * rows[2] / span[:, None] ** 2
    return Local(rows[0], rows[1] / span[:, None], bend, gain[:, 0], slope_gain, np.sqrt(off))


def _alike(rows: Array) -> tuple[Array, NDArray[np.intp]]:
    """The rows (n, k) of an array (T, k) that differ in any bit, and which of them each of its rows is, (T,)."""
    raw, width = np.ascontiguousarray(rows).tobytes(), rows.itemsize * rows.shape[1]
    known: dict[bytes, int] = {}
    of = [known.setdefault(raw[i : i + width], len(known)) for i in range(0, len(raw), width)]
    return np.frombuffer(b"".join(known), rows.dtype).reshape(-1, rows.shape[1]), np.array(of, np.intp)


def fresh_samples(time: Array, values: Array, rate: float | None) -> NDArray[np.intp]:
    """Indices at which a signal that is held between updates was renewed; every index where no `rate` (Hz) is given."""
    if rate is None or rate <= 0:
        return np.arange(len(time))
    columns = values.reshape(len(time), -1)
    changed = np.flatnonzero((np.diff(columns, axis=0) != 0).any(1)) + 1
    index = np.concatenate([[0], changed])
    return index if len(index) >= 4 else np.arange(len(time))


def estimate_noise(values: Array) -> float:
    """Standard deviation of white noise on a smooth signal (N,) or (N, k), from the spread of its third differences.

    Third differences of white noise have 20 times its variance while a smooth signal hardly shows in them. The median
    absolute value ignores the instants where the signal is not smooth. An encoder's differences are whole steps, of
    which the median is one or the next: it lies within the step that holds it, as of grouped data. Never less than what
    a quantised signal's step implies.
    """
    columns = values.reshape(len(values), -1)
    if len(columns) < 8:
        return 0.0
    third = np.abs(np.diff(columns, 3, axis=0))
    steps = np.abs(np.diff(columns, axis=0))
    moved = steps[steps > 0]
    quantum = float(moved.min()) if moved.size else 0.0
    noise = 1.4826 * _grouped_median(third, quantum) / np.sqrt(20)
    return float(max(noise, quantum / np.sqrt(12)))


def _grouped_median(sizes: Array, width: float) -> float:
    """Median of sizes >= 0 that were rounded to multiples of a width: where in its group half of them are reached."""
    middle = float(np.median(sizes))
    low, high = max(middle - width / 2, 0.0), middle + width / 2
    below, within = float((sizes < low).mean()), float(((sizes >= low) & (sizes < high)).mean())
    return low + (high - low) * min(max(0.5 - below, 0.0) / within, 1.0) if within > 0 else middle


def moving_average(values: Array, samples: int, mask: NDArray[np.bool_] | None = None) -> Array:
    """Mean over a centred window along the first axis, of the samples that there are: fewer at the ends.

    Args:
      values: (T, ...).
      samples: width of the window.
      mask: (T, ...) which values count, whatever stands in the others; None is all. Where none in the window does, 0.
    """
    if mask is not None:
        values = np.where(mask, values, 0.0)
    elif samples <= 1:
        return values
    share = covered(np.ones(values.shape, bool) if mask is None else mask, samples)
    return _windowed(values, samples) / np.where(share > 0, share, 1.0)


def centred_average(values: Array, samples: int) -> Array:
    """The same (T,), but narrower at the ends, so that a window reaches as far to either side: no slope moves it."""
    out, size = moving_average(values, samples).copy(), len(values)
    for k in range(min(samples // 2, size)):
        for at in (k, size - 1 - k):
            reach = min(at, size - 1 - at)
            out[at] = values[at - reach : at + reach + 1].mean()
    return out


def covered(mask: NDArray[np.bool_], samples: int) -> Array:
    """Share of a centred window of so many samples that counts, (T, ...) as the mask; exactly 1 where all do."""
    return np.rint(_windowed(mask.astype(float), samples) * samples) / samples


def _windowed(values: Array, samples: int) -> Array:
    """Sums over the window divided by its width, with zeros beyond the ends."""
    if samples <= 1:
        return values
    kernel = np.ones(samples) / samples
    columns, cut = values.reshape(len(values), -1), (samples - 1) // 2
    out = np.stack([np.convolve(c, kernel)[cut : cut + len(c)] for c in columns.T], -1)
    return out.reshape(values.shape)
