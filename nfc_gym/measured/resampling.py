"""Samples brought to other times: held or interpolated, and which rows the samples of a slow sensor fall on."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLOCKS = 10  # stretches of a stream, in each of which some message came without waiting
EACH = 10  # messages that such a stretch has at least
BEHIND = 5  # messages in each of two stretches of the same times, which a clock that was set back makes
SELDOM = 5  # times that a clock is set back at most; two senders of one topic take turns throughout
BEAT = 0.5, 1.5  # of the usual interval: between these lie nine in ten of a stream that comes at a beat
WRAP = 0.8, 1.2  # of a full turn: a step between these is an angle that was wrapped


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

    def silence(self, until: float, most: float) -> float:
        """The longest time in s without a sample, up to `until`, of a stream that comes at a beat otherwise.

        Args:
          most: of its usual intervals; 0 is given for shorter ones, and for a stream that sends when there is need.
        """
        steps = np.diff(self.time)
        if not steps.size or np.mean((steps > BEAT[0] * self.interval) & (steps < BEAT[1] * self.interval)) < 0.9:
            return 0.0
        longest = max(self.longest, until - float(self.time[-1]))
        return longest if longest > most * self.interval else 0.0


def set_back(raw: Array, most: float) -> tuple[int, float] | None:
    """Where times (N,) s go back by more than `most` s and stay behind those before, as of a clock that is set.

    Returns:
      The first such sample and by how much, s; None where samples merely overtake each other or two senders take turns.
    """
    back = np.flatnonzero(np.diff(raw) < -most) + 1
    if not 0 < len(back) <= SELDOM:
        return None
    latest = np.maximum.accumulate(raw)
    for k in back:
        after = raw[k : k + BEHIND]
        if (after < latest[k - 1]).sum() == BEHIND <= (raw[:k] > raw[k]).sum():
            return int(k), float(raw[k - 1] - raw[k])
    return None


def wandering(stamps: NDArray[np.int64], received: NDArray[np.int64]) -> float:
    """By how many s the clock of `stamps` (N,) ns moves against that of `received`, in the course of a recording.

    A message may wait, so that of each stretch the one that came soonest tells how the clocks lie.
    """
    count = min(BLOCKS, len(stamps) // EACH)
    if count < 2:
        return 0.0
    soonest = [int(part.min()) for part in np.array_split(received - stamps, count)]
    return (max(soonest) - min(soonest)) * 1e-9


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


def interpolated(
    time: Array, values: Array, at: Array, gap: float, rotation: bool = False, turn: float | None = None
) -> Array:
    """Samples (N, k) at times (N,) s, interpolated to (T, k) at times `at`; NaN outside and in pauses over `gap` s.

    Args:
      rotation: the samples are unit quaternions (either scalar order), interpolated along the shorter arc at constant
        speed (Shoemake, Animating rotation with quaternion curves, SIGGRAPH 1985).
      turn: of angles, a full turn in their unit. Where one was wrapped the sample before is held: half way between pi
        and -pi lies 0, where nothing was, and the jump must stay whole to be recognised.
    """
    low = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    width = time[low + 1] - time[low]
    part = ((at - time[low]) / width)[:, None]
    on_sample = (part == 0) | (part == 1)
    out = (_arc if rotation else _line)(values[low], values[low + 1], part)
    if turn is not None:
        step = np.abs(values[low + 1] - values[low]) / turn
        out = np.where((step > WRAP[0]) & (step < WRAP[1]), values[low], out)
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
