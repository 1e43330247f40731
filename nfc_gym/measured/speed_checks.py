"""Positions against measured speeds of the same motion: units, signs, the clock's unit, another motion's column."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import Channel, Log, units
from nfc_gym.measured.channels import parse_channel
from nfc_gym.measured.entries import TimeColumn
from nfc_gym.measured.findings import Suspicion
from nfc_gym.measured.offsets import agreement
from nfc_gym.measured.smoothing import covered, estimate_noise, fresh_samples, moving_average

Array = NDArray[np.float64]

DEGREES = 180 / np.pi
TURN = 5.0, 7.5  # rad; a jump between these is a wrapped full turn
# derivative of the position over the measured speed -> what explains it
_RATIOS = {
    DEGREES: "the position is in degrees where radians are declared",
    1 / DEGREES: "the speed is in degrees/s where rad/s is declared",
    np.pi / 30: "the speed is in rpm where rad/s is declared",
    -1.0: "position and speed have opposite signs",
}
_NEAR = 0.25  # a ratio's logarithm may differ so much from that of what explains it
_CLOCKS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # units of time -> s

SEEN = 10.0  # times its noise, by which a motion must show before it is compared
STRANGE = 0.7  # correlation with its own speed below which a position may be that of another motion
CLEAR = 0.95  # correlation with another motion's speed above which it is
UNLIKE = 0.5  # correlation, at any offset of the clocks, below which a position follows no speed of its own
WHOLE = 40  # rows in unmasked stretches from which a speed is judged by these alone
LEAST = 100  # samples from which motions can be told from each other
SHORTEST, FEWEST = 4, 8  # samples of the shortest stretch of motion; stretches of the longest, that a log must hold
FASTEST = 100.0  # m/s, above which a length is more likely in another unit
MOST = 0.2  # of the log, by which two clocks may differ
PAUSE = 5.0  # sampling intervals; no motion is compared across longer pauses


class _Motion(NamedTuple):
    """One component of a position and the measured speed of it.

    Attributes:
      channel: of the position.
      axis: the component's name; empty for joints.
      unit: of the position.
      position, speed: (T,) in rows of the log.
      here, there: (n,), (m,) rows that are samples of position and speed.
    """

    channel: str
    axis: str
    unit: str
    position: Array
    speed: Array
    here: NDArray[np.intp]
    there: NDArray[np.intp]

    @property
    def name(self) -> str:
        """What messages call it."""
        of = self.channel.removesuffix(":pos")
        return f"{self.axis} of {of}" if self.axis else of


def _motions(log: Log) -> list[_Motion]:
    """Joints, and components of bodies in the world's frame, of which position and speed are measured."""
    out = []
    for name, channel in log.channels.items():
        parsed = parse_channel(name)
        if parsed.kind not in ("joint", "body") or parsed.quantity != "pos" or parsed.own_frame:
            continue
        rate = f"joint:{parsed.object}:vel" if parsed.kind == "joint" else f"body:{parsed.object}:linvel"
        speed = log.channels.get(rate)
        if speed is None or speed.values.shape != channel.values.shape or channel.axes != speed.axes:
            continue
        samples = _samples(log, channel), _samples(log, speed)
        columns = (c.values.reshape(len(log), -1).T for c in (channel, speed))
        for i, (x, v) in enumerate(zip(*columns, strict=True)):
            axis = "" if parsed.kind == "joint" else "xyz"[i if channel.axes is None else channel.axes[i]]
            out.append(_Motion(name, axis, channel.unit, x, v, *samples))
    return out


def _samples(log: Log, channel: Channel) -> NDArray[np.intp]:
    rows = fresh_samples(log.time, channel.values, channel.rate)
    return rows if channel.mask is None else rows[channel.mask[rows]]


def ratio(x: Array, y: Array) -> float | None:
    """Slope of y over x, of either sign, where the two follow each other (correlation above 0.8); else None."""
    if not len(x):
        return None
    x, y = x - x.mean(), y - y.mean()
    spread = float(np.linalg.norm(x) * np.linalg.norm(y))
    if spread == 0 or abs(float(x @ y)) < 0.8 * spread:
        return None
    return float(np.linalg.norm(y) / np.linalg.norm(x)) * float(np.sign(x @ y))


def rate_ratio(log: Log, position: Array, speed: Array, masks: Sequence[NDArray[np.bool_] | None] = ()) -> float | None:
    """Derivative over measured speed, both (T,) and smoothed over nine samples, where the two follow each other.

    Args:
      log: where they come from.
      position, speed: (T,).
      masks: (T,) each, true where a channel was measured: stretches in which all were are compared, unless masked rows
        lie between all samples, as of a slow sensor.
    """
    n = min(9, max(len(log) // 10, 1))
    derived = np.gradient(position, log.time)
    seen = np.logical_and.reduce([np.ones(len(log), bool), *(m for m in masks if m is not None)])
    whole = covered(seen, n + 2)[n:-n] == 1  # a slope reaches to the rows on both sides
    if whole.sum() < WHOLE:
        whole[:] = True
    return ratio(moving_average(speed, n)[n:-n][whole], moving_average(derived, n)[n:-n][whole])


def explained(where: str, found: float) -> Iterator[Suspicion]:
    """What makes an angle's derivative `found` times its measured speed (see `rate_ratio`)."""
    if 0.7 < found < 1.4:
        return
    for factor, what in _RATIOS.items():
        if found * factor > 0 and abs(np.log(found / factor)) < _NEAR:
            message = f"its derivative is {found:.3g} times the measured speed: {what}"
            yield Suspicion(
                "error", where, "degrees", message, "correct the `unit` (deg, deg/s, rpm), or the column's sign"
            )
            return
    message = f"its derivative is {found:.3g} times the measured speed"
    advice = "check both columns, their units, that of time, and any gear ratio"
    yield Suspicion("warning", where, "speed", message, advice)


def clock_unit(log: Log, entry: TimeColumn) -> str:
    """What positions and speeds say of the unit of time, where it is another than the declared one; else empty.

    Args:
      log: as read with `entry`.
      entry: the mapping's `time`.
    """
    found = [rate_ratio(log, m.position, m.speed) for m in _motions(log)]
    ratios = [r for r in found if r is not None and r > 0]
    if not ratios:
        return ""
    typical = float(np.median(ratios))
    factor = 1000.0 ** round(np.log10(typical) / 3)
    if factor == 1 or abs(np.log(typical / factor)) > _NEAR:
        return ""
    said = f"the derivative of positions is {typical:.3g} times the measured speed"
    if entry.interval is not None:
        return f"{said}, as if `interval` were {factor:g} times as long"
    scale = float(units.to_si(1.0, entry.unit)) * factor
    meant = next((unit for unit, seconds in _CLOCKS.items() if np.isclose(seconds, scale)), None)
    return said if meant is None else f"{said}, as if times in {meant} were declared as {entry.unit}"


def strangers(log: Log) -> Iterator[Suspicion]:
    """Positions that do not follow their own measured speed, and whose speed they follow, if anybody's.

    The change of the position and the sum of the speed are compared over stretches of several lengths, of which the
    longer ones average noise away. A length counts only where both are far above their noise, and a position is strange
    only where they agree at none that counts.
    """
    motions = _motions(log)
    for motion in motions:
        jump = np.abs(np.diff(motion.position))
        if motion.unit == "rad" and ((jump > TURN[0]) & (jump < TURN[1])).any():
            continue
        own = _alike(log.time, motion, motion)
        if own is None or own >= STRANGE:
            continue
        message = f"{motion.axis} does not" if motion.axis else "does not"
        message += f" follow its own measured speed (correlation {own:.2f})"
        rest = [m for m in motions if m is not motion and m.unit == motion.unit]
        found = [(_alike(log.time, motion, m) or 0.0, m.name) for m in rest]
        best, other = max(found, default=(0.0, ""))
        if best > CLEAR:
            message += f", it follows that of {other} ({best:.2f})"
        elif (_alike(log.time, motion, motion, offsets=True) or 0.0) >= UNLIKE:
            continue
        advice = "name the columns of one and the same motion, or check the speed's frame"
        yield Suspicion("warning", f"channels.{motion.channel}", "stranger", message, advice)


def too_fast(log: Log) -> Iterator[Suspicion]:
    """Slides and bodies that move as nothing does that is measured so: a length in mm was declared as one in m."""
    for name, channel in log.channels.items():
        parsed = parse_channel(name)
        if parsed.kind not in ("joint", "body") or channel.unit not in ("m", "m/s"):
            continue
        rows = _samples(log, channel)
        if len(rows) < LEAST:
            continue
        values = channel.values.reshape(len(log), -1)[rows]
        if channel.unit == "m":
            values = moving_average(np.gradient(values, log.time[rows], axis=0), 9)[9:-9]
        typical = float(np.quantile(np.linalg.norm(values, axis=-1), 0.9))
        if typical > FASTEST:
            message = f"it moves at {typical:.3g} m/s"
            advice = "check its `unit` (is it in mm?), and that of time"
            yield Suspicion("warning", f"channels.{name}", "fast", message, advice)


def _alike(time: Array, of: _Motion, to: _Motion, offsets: bool = False) -> float | None:
    """The largest correlation, of either sign, of a motion's position with a motion's speed over all stretches.

    Args:
      time: (T,) s.
      of: whose position it is.
      to: whose speed it is.
      offsets: look at all offsets between their clocks, up to `MOST` of the log.

    Returns:
      None where they share too few samples, or no stretch shows both far above their noise.
    """
    begun, ended = zip(_stretch(time[of.here]), _stretch(time[to.there]), strict=True)
    rows = [r[(time[r] >= max(begun)) & (time[r] <= min(ended))] for r in (of.here, to.there)]
    if min(map(len, rows)) < LEAST:
        return None
    t, s = (time[r] for r in rows)
    x, v = of.position[rows[0]], to.speed[rows[1]]
    step = max(float(np.median(np.diff(t))), float(np.median(np.diff(s))))
    grid = np.arange(max(t[0], s[0]), min(t[-1], s[-1]), step)
    way = np.interp(grid, s, np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) / 2 * np.diff(s))]))
    place = np.interp(grid, t, x)
    noise = np.sqrt(2) * estimate_noise(x), estimate_noise(v) * step
    found, n = [], SHORTEST
    while n <= len(grid) // FEWEST:
        moved, summed = (signal[n:] - signal[:-n] for signal in (place, way))
        if moved.std() > SEEN * noise[0] and summed.std() > SEEN * noise[1] * np.sqrt(n):
            most = int(MOST * len(moved)) if offsets else 0
            found.append(float(np.abs(agreement(moved - moved.mean(), summed - summed.mean(), most)).max()))
        n *= 2
    return max(found, default=None)


def _stretch(time: Array) -> tuple[float, float]:
    """First and last of the times (n,) of the longest run without a pause; two equal times where there is none."""
    if len(time) < 2:
        return 0.0, 0.0
    step = np.diff(time)
    edges = np.concatenate([[0], np.flatnonzero(step > PAUSE * np.median(step)) + 1, [len(time)]])
    k = int(np.diff(edges).argmax())
    return float(time[edges[k]]), float(time[edges[k + 1] - 1])
