"""Clocks that disagree: two sensors of one motion, one of which shows it later. Reported, never repaired unasked."""

from collections.abc import Iterator, Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import Channel, Log
from nfc_gym.measured.channels import parse_channel
from nfc_gym.measured.even import Evened
from nfc_gym.measured.findings import Finding, Suspicion
from nfc_gym.measured.offsets import Offset, clock_offset
from nfc_gym.measured.smoothing import fresh_samples
from nfc_gym.physics.state import quat_conjugate, quat_multiply, quat_to_vector, rotate, rotate_back

Array = NDArray[np.float64]

AGREE = 0.8  # correlation from which on two signals are taken for the same motion
SURE = 4.0  # standard deviations, with which an offset is not zero
SHARE = 0.25  # of a sampling interval: a smaller offset is none to speak of
# The same of a speed after its position, where a new command comes with about every sample: a drive that follows it
# before the next one has reached its speed when it is sampled, and moves on at the mean of both around that moment.
HELD = 0.5
COARSE = 1.0  # the same of a motion that the samples do not resolve: what happens between two of them looks like one
RESOLVED = 0.7  # change from sample to sample over the speed's own spread, below which they do
MOST = 2.0  # s, or a fifth of the log where that is less
FEWEST = 16  # samples of a channel from which motion can be told
LONGEST = 10_000  # samples of a channel that are compared


def shift_notes(shifts: Mapping[str, float]) -> Iterator[Finding]:
    """What the mapping's `shift` of each channel (s, name -> value) does to it."""
    for name, shift in shifts.items():
        if shift:
            way = "late" if shift > 0 else "early"
            message = f"its stamps are taken to be {1e3 * abs(shift):.4g} ms {way}, as its `shift` says"
            yield Finding("note", f"channels.{name}", message, "it is interpolated to the rows of the log")


def even_rows(found: Evened) -> Suspicion:
    """That stamps scatter, and what was taken for them."""
    message = (
        f"its stamps scatter by {1e3 * found.scatter:.2g} ms about rows {1e3 * found.interval:.4g} ms apart, and what "
        f"was measured is {found.nearer:.2g} times nearer to smooth curves in even rows: these are taken for its times"
    )
    return Suspicion("note", "time", "even", message, "stamp the samples where they are taken")


def clock_offsets(model: mujoco.MjModel | None, logs: Sequence[Log], shifts: Mapping[str, float]) -> Iterator[Finding]:
    """Pairs of channels that measure one motion at different times, over all logs, each told where the later one is.

    Args:
      model: to find the sites of gyroscopes; None leaves those out.
      logs: with the mapping's shifts taken out.
      shifts: these, s, channel -> value; what is advised comes on top.
    """
    found: dict[tuple[str, str], list[tuple[str, Offset, float]]] = {}
    for log in logs:
        for position, speed, time, travel in _pairs(model, log):
            other, rate = _samples(log, log.channels[speed])
            if len(other) < FEWEST:
                continue
            rate = rate.reshape(len(rate), -1)
            offset = clock_offset(time, travel, other, rate, min(MOST, 0.2 * log.duration))
            if offset is not None and offset.correlation > AGREE and offset.sd > 0:
                coarsest = max(float(np.median(np.diff(t))) for t in (time, other))
                held = HELD if offset.seconds > 0 and _commanded(log, coarsest) else SHARE
                least = coarsest * (held if _resolved(rate) else COARSE)
                found.setdefault((position, speed), []).append((log.name, offset, least))
    for (position, speed), offsets in found.items():
        yield from _told(position, speed, offsets, shifts)


def _told(
    position: str, speed: str, offsets: list[tuple[str, Offset, float]], shifts: Mapping[str, float]
) -> Iterator[Finding]:
    """The weighted mean over logs, its deviation widened where they scatter by more than their own.

    Args:
      offsets: of each log its name, the offset, and s below which an offset is none to speak of.
    """
    each, sd = (np.array([getattr(o, key) for _, o, _ in offsets]) for key in ("seconds", "sd"))
    mean = float((each / sd**2).sum() / (1 / sd**2).sum())
    spread = ((each - mean) ** 2 / sd**2).sum() / max(len(each) - 1, 1)
    deviation = float(np.sqrt(max(spread, 1.0) / (1 / sd**2).sum()))
    if abs(mean) < max(SURE * deviation, float(np.median([least for *_, least in offsets]))):
        return
    late, early = (speed, position) if mean > 0 else (position, speed)
    size = 1e3 * abs(mean)
    message = f"comes {size:.3g} ± {1e3 * deviation:.1g} ms after {early}, by the motion that both show"
    if len(each) > 1:
        low, high = sorted(1e3 * np.sign(mean) * np.quantile(each, (0, 1)))
        message += f" in {len(each)} logs (single ones {low:.3g} to {high:.3g} ms)"
    before = shifts.get(late, 0.0)
    message += ": two clocks, or a filter; nothing was shifted"
    message += f" beyond its `shift` of {before:g} s" if before else ""
    advice = (
        f"to take it out, write `shift: {before + abs(mean):.4g}` under channels.{late}, "
        f"or let the loop weigh sensor_delay:{late}"
    )
    yield Finding("warning", f"channels.{late}", message, advice)


def _resolved(rate: Array) -> bool:
    """Whether a speed, (T, k), goes over from sample to sample; one that jumps is another between them."""
    return bool(np.diff(rate, axis=0).std() < RESOLVED * rate.std(0).mean())


def _commanded(log: Log, interval: float) -> bool:
    """Whether commands are held about as long as `interval` s."""
    changes = max((int(np.count_nonzero(np.diff(series))) for series in log.controls.values()), default=0)
    return 0.5 * log.duration < changes * interval < 1.5 * log.duration


def _pairs(model: mujoco.MjModel | None, log: Log) -> Iterator[tuple[str, str, Array, Array]]:
    """(position, channel of its rate, times (T,), position (T, k) in that channel's frame, up to a constant)."""
    for name, channel in log.channels.items():
        parsed = parse_channel(name)
        if parsed.quantity not in ("pos", "quat") or parsed.own_frame:
            continue
        time, values = _samples(log, channel)
        if len(time) < FEWEST:
            continue
        if parsed.quantity == "pos":
            speed = f"joint:{parsed.object}:vel" if parsed.kind == "joint" else f"body:{parsed.object}:linvel"
            if speed in log.channels:
                yield name, speed, time, values.reshape(len(time), -1)
            continue
        steps = quat_to_vector(quat_multiply(quat_conjugate(values[:-1]), values[1:]))
        for other, frame in gyros(model, log, parsed.object):
            seen = rotate(values[:-1], steps) if frame is None else rotate_back(frame, steps)
            axes = log.channels[other].axes
            turned = np.concatenate([np.zeros((1, 3)), np.cumsum(seen, 0)])
            yield name, other, time, turned if axes is None else turned[:, list(axes)]


def _samples(log: Log, channel: Channel) -> tuple[Array, Array]:
    """A channel's own samples: where it is compared, and where a held one was renewed; the first `LONGEST`."""
    rows = fresh_samples(log.time, channel.values, channel.rate)
    rows = (rows if channel.mask is None else rows[channel.mask[rows]])[:LONGEST]
    return log.time[rows], channel.values[rows]


def gyros(model: mujoco.MjModel | None, log: Log, body: str) -> Iterator[tuple[str, Array | None]]:
    """Channels that measure a body's angular velocity, and the frame they do so in: None is the world's."""
    for name in log.channels:
        parsed = parse_channel(name)
        if parsed.object == body and parsed.quantity == "angvel":
            yield name, np.array([1.0, 0, 0, 0]) if parsed.own_frame else None
        if model is None or parsed.kind != "sensor":
            continue
        s = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, parsed.object)
        if s >= 0 and int(model.sensor_type[s]) == int(mujoco.mjtSensor.mjSENS_GYRO):
            site = int(model.sensor_objid[s])
            if mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, int(model.site_bodyid[site])) == body:
                yield name, model.site_quat[site]
