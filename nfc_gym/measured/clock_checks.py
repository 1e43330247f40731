"""Clocks that disagree: two sensors of one motion, one of which shows it later. Reported, never repaired."""

from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import Channel, Log
from nfc_gym.measured.channels import parse_channel
from nfc_gym.measured.findings import Suspicion
from nfc_gym.measured.offsets import clock_offset
from nfc_gym.measured.smoothing import fresh_samples, local_polynomial
from nfc_gym.physics.state import quat_conjugate, quat_multiply, quat_to_vector, rotate, rotate_back

Array = NDArray[np.float64]

AGREE = 0.8  # correlation from which on two signals are taken for the same motion
SURE = 4.0  # standard deviations, with which an offset is not zero
SHARE = 0.25  # of a sampling interval: a smaller offset is none to speak of
MOST = 2.0  # s, or a fifth of the log where that is less
LONGEST = 20_000  # samples of a channel that are compared


def clock_offsets(model: mujoco.MjModel | None, log: Log) -> Iterator[Suspicion]:
    """Pairs of channels that measure one motion at different times, each told once, where the later one is."""
    for position, speed, time_a, a in _pairs(model, log):
        time_b, b = _samples(log, log.channels[speed])
        offset = clock_offset(time_a, a, time_b, b.reshape(len(b), -1), min(MOST, 0.2 * log.duration))
        if offset is None or offset.correlation < AGREE:
            continue
        coarsest = max(float(np.median(np.diff(t))) for t in (time_a, time_b))
        if abs(offset.seconds) < max(SURE * offset.sd, SHARE * coarsest):
            continue
        late, early = (speed, position) if offset.seconds > 0 else (position, speed)
        size = 1e3 * abs(offset.seconds)
        message = f"comes {size:.3g} ± {1e3 * offset.sd:.1g} ms after {early}, by the motion that both show "
        message += f"(correlation {offset.correlation:.2f}): two clocks, or a filter"
        advice = (
            f"subtract {size:.3g} ms from its stamps, or let the loop weigh sensor_delay:{late}; nothing was shifted"
        )
        yield Suspicion("warning", f"channels.{late}", f"clock {early}", message, advice)


def _pairs(model: mujoco.MjModel | None, log: Log) -> Iterator[tuple[str, str, Array, Array]]:
    """(position, channel of its rate, times (T,), the position's own rate (T, k) in that channel's frame)."""
    for name, channel in log.channels.items():
        parsed = parse_channel(name)
        if parsed.quantity not in ("pos", "quat") or parsed.own_frame:
            continue
        time, values = _samples(log, channel)
        if len(time) < 8:
            continue
        if parsed.quantity == "pos":
            speed = f"joint:{parsed.object}:vel" if parsed.kind == "joint" else f"body:{parsed.object}:linvel"
            if speed in log.channels:
                rate = local_polynomial(time, values.reshape(len(time), -1), time).slope
                yield name, speed, time, rate
            continue
        turning = _turning(time, values)
        for other, frame in _gyros(model, log, parsed.object):
            seen = rotate(values, turning) if frame is None else rotate_back(frame, turning)
            axes = log.channels[other].axes
            yield name, other, time, seen if axes is None else seen[:, list(axes)]


def _samples(log: Log, channel: Channel) -> tuple[Array, Array]:
    """A channel's own samples: where it is compared, and where a held one was renewed; the first `LONGEST`."""
    rows = fresh_samples(log.time, channel.values, channel.rate)
    rows = (rows if channel.mask is None else rows[channel.mask[rows]])[:LONGEST]
    return log.time[rows], channel.values[rows]


def _turning(time: Array, quat: Array) -> Array:
    """(T, 3) angular velocity in the body's frame, rad/s, by local cubics through the rotation so far."""
    steps = quat_to_vector(quat_multiply(quat_conjugate(quat[:-1]), quat[1:]))
    return local_polynomial(time, np.concatenate([np.zeros((1, 3)), np.cumsum(steps, 0)]), time).slope


def _gyros(model: mujoco.MjModel | None, log: Log, body: str) -> Iterator[tuple[str, Array | None]]:
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
