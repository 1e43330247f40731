"""Samples brought to other times: held or interpolated, and which rows the samples of a slow sensor fall on."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Clock:
    """Times (N,) s of a stream, in order and each once.

    Attributes:
      time: (M,) s, increasing.
      order: (M,) which samples they belong to; of those with one stamp, the last that came.
      interval, longest: s, the median and the longest step.
      repeated, disordered: samples whose stamp another has, and those that came before an earlier one.
    """

    def __init__(self, raw: Array) -> None:
        self.order = np.argsort(raw, kind="stable")
        self.disordered = int((np.diff(raw) < 0).sum())
        ordered = raw[self.order]
        last = np.append(np.diff(ordered) > 0, True)
        self.repeated = int((~last).sum())
        self.order, self.time = self.order[last], ordered[last]
        steps = np.diff(self.time)
        self.interval = float(np.median(steps)) if steps.size else 0.0
        self.longest = float(steps.max()) if steps.size else 0.0


def held(time: Array, values: Array, at: Array) -> Array:
    """Samples (N, k) at times (N,) s, each held until the next: (T, k) at times `at`; NaN before the first."""
    index = np.searchsorted(time, at, side="right") - 1
    return np.where((index < 0)[:, None], np.nan, values[np.maximum(index, 0)])


def flagged(time: Array, values: Array, at: Array) -> Array:
    """Flags (N, k) of samples at times (N,) s: (T, k) at times `at`, 1 where those on either side are both 1, else 0.

    What is interpolated between a good sample and a bad one is bad. Other values than 0 and 1 are held as they are, for
    others to refuse.
    """
    if not np.isin(values, (0.0, 1.0)).all():
        return held(time, values, at)
    return np.where(interpolated(time, values, at, np.inf) == 1, 1.0, 0.0)


def interpolated(time: Array, values: Array, at: Array, gap: float, rotation: bool = False) -> Array:
    """Samples (N, k) at times (N,) s, interpolated to (T, k) at times `at`; NaN outside and in pauses over `gap` s.

    Args:
      rotation: the samples are unit quaternions (either scalar order), interpolated along the shorter arc at constant
        speed (Shoemake, Animating rotation with quaternion curves, SIGGRAPH 1985).
    """
    low = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    width = time[low + 1] - time[low]
    part = ((at - time[low]) / width)[:, None]
    on_sample = (part == 0) | (part == 1)
    out = (_arc if rotation else _line)(values[low], values[low + 1], part)
    out = np.where(on_sample, np.where(part == 0, values[low], values[low + 1]), out)
    bridged = on_sample[:, 0] | (width <= gap * (1 + 1e-9))
    return np.where((bridged & (at >= time[0]) & (at <= time[-1]))[:, None], out, np.nan)


def _line(a: Array, b: Array, part: Array) -> Array:
    return a + (b - a) * part


def _arc(a: Array, b: Array, part: Array) -> Array:
    # In terms of the four-dimensional dot product alone, so that it holds for either scalar order.
    norm = np.linalg.norm(a, axis=1, keepdims=True) * np.linalg.norm(b, axis=1, keepdims=True)
    cosine = (a * b).sum(1, keepdims=True) / np.where(norm > 0, norm, 1.0)
    b, angle = np.where(cosine < 0, -b, b), np.arccos(np.clip(np.abs(cosine), 0, 1))
    sine = np.sin(angle)
    near = sine < 1e-6
    safe = np.where(near, 1.0, sine)
    left = np.where(near, 1 - part, np.sin((1 - part) * angle) / safe)
    right = np.where(near, part, np.sin(part * angle) / safe)
    return left * a + right * b


def nearest_rows(time: Array, at: Array) -> NDArray[np.bool_]:
    """Of the times `at` (T,), those that are nearest to one of `time` (N,): (T,) bool."""
    right = np.clip(np.searchsorted(at, time), 1, len(at) - 1)
    nearest = np.where(time - at[right - 1] <= at[right] - time, right - 1, right)
    rows, half = np.zeros(len(at), bool), 0.5 * np.median(np.diff(at))
    rows[nearest[(time >= at[0] - half) & (time <= at[-1] + half)]] = True
    return rows


def lateness(time: Array, at: Array) -> float:
    """Mean time in s from a command's stamp to the first of the times `at` that shows it."""
    inside = time[(time >= at[0]) & (time <= at[-1])]
    return float((at[np.searchsorted(at, inside)] - inside).mean()) if inside.size else 0.0
