"""Attitudes and velocities that do not fit each other as declared, and do when they are read otherwise. Never repaired.

World and body exchanged, an attitude from world to body, rates in degrees: what a body's attitude or place changes by
is compared with its measured rates, as declared and in each other reading.
"""

from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import Channel, Log
from nfc_gym.measured.channels import parse_channel
from nfc_gym.measured.clock_checks import gyros
from nfc_gym.measured.findings import Severity, Suspicion
from nfc_gym.measured.smoothing import moving_average
from nfc_gym.physics.state import quat_conjugate, quat_multiply, quat_to_vector, rotate, rotate_back

Array = NDArray[np.float64]

DOUBTED = 0.15  # error of a reading, relative to the rates, from which on it is doubted
CLEARLY = 0.3  # times that error: another reading that leaves less is the right one
SLOW = 0.05  # rad/s, m/s; below this mean rate nothing is told
_SMOOTH = 9  # samples; derivatives of noise are large


def exchanged(model: mujoco.MjModel | None, log: Log) -> Iterator[Suspicion]:
    """Of each free body whose attitude is measured, what fits its rates in another reading alone.

    Args:
      model: to find the sites of gyroscopes; None leaves those out.
    """
    for name, channel in log.channels.items():
        parsed = parse_channel(name)
        if parsed.quantity == "quat" and _throughout(channel):
            yield from _attitude(model, log, name, parsed.object)
            yield from _velocity(log, channel.values, parsed.object)


def _throughout(channel: Channel | None) -> bool:
    """Whether all of a channel's components were measured in every row."""
    return channel is not None and channel.mask is None and channel.rate is None and channel.axes is None


def _attitude(model: mujoco.MjModel | None, log: Log, name: str, body: str) -> Iterator[Suspicion]:
    quat = log.channels[name].values
    other, frame = next(((n, f) for n, f in gyros(model, log, body) if _throughout(log.channels[n])), ("", None))
    if not other or log.channels[other].values.shape != (len(log), 3):
        return
    rates, along = log.channels[other].values, f"channels.{other}"
    rates = rates if frame is None else rotate(frame, rates)
    in_body = frame is not None
    readings: dict[str, tuple[float, Severity, str, str]] = {
        "as from the world to the body": (
            _turning(log.time, quat_conjugate(quat), rates, in_body), "error", f"channels.{name}",
            "give the attitude from the body to the world: negate x, y and z of the quaternion",
        ),
        "in degrees": (
            _turning(log.time, quat, np.deg2rad(rates), in_body), "error", along, "say `unit: deg/s`",
        ),
    }  # fmt: skip
    if parse_channel(other).kind == "body":
        meant = f"body:{body}:angvel" + ("" if in_body else "@body")
        axes = "the world's axes" if in_body else "the body's own axes"
        turned = _turning(log.time, quat, rates, not in_body)
        readings[f"along {axes}"] = turned, "warning", along, f"call the channel {meant}, if they are"
    wrong = _turning(log.time, quat, rates, in_body)
    yield from _other("attitude's own turning", wrong, readings)


def _velocity(log: Log, quat: Array, body: str) -> Iterator[Suspicion]:
    place = log.channels.get(f"body:{body}:pos")
    if place is None or not _throughout(place):
        return
    moved = np.gradient(place.values, log.time, axis=0)
    for own in (False, True):
        name = f"body:{body}:linvel" + ("@body" if own else "")
        speed = log.channels.get(name)
        if speed is None or not _throughout(speed):
            continue
        wrong, otherwise = (
            _apart(moved, rotate(quat, speed.values) if in_body else speed.values) for in_body in (own, not own)
        )
        axes = "the world's axes" if own else "the body's own axes"
        meant = f"body:{body}:linvel" + ("" if own else "@body")
        advice = f"call the channel {meant}, if they are"
        yield from _other(
            "place's change", wrong, {f"along {axes}": (otherwise, "warning", f"channels.{name}", advice)}
        )


def _other(what: str, wrong: float, readings: dict[str, tuple[float, Severity, str, str]]) -> Iterator[Suspicion]:
    """The reading that leaves the least error, where it is clearly less than that of the declared one."""
    how, (error, severity, where, advice) = min(readings.items(), key=lambda r: r[1][0])
    if wrong > DOUBTED and error < CLEARLY * wrong:
        message = f"the {what} is off the measured rates by {wrong:.0%}, and by {error:.0%} where this is read {how}"
        yield Suspicion(severity, where, "frame", message, advice)


def _turning(time: Array, quat: Array, rates: Array, in_body: bool) -> float:
    """Distance of an attitude's own rotation rate (T, 4) from a measured one (T, 3), relative to it."""
    steps = quat_to_vector(quat_multiply(quat_conjugate(quat[:-1]), quat[1:])) / np.diff(time)[:, None]
    return _apart(steps, rates[:-1] if in_body else rotate_back(quat[:-1], rates[:-1]))


def _apart(derived: Array, measured: Array) -> float:
    """Distance of two rates (T, 3) from each other, relative to the larger; 0 where both hardly move."""
    derived, measured = (moving_average(v, _SMOOTH)[_SMOOTH:-_SMOOTH] for v in (derived, measured))
    size = max(float(np.linalg.norm(v)) for v in (derived, measured))
    return float(np.linalg.norm(derived - measured)) / size if size > SLOW * np.sqrt(max(len(derived), 1)) else 0.0
