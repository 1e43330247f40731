"""What looks wrong in orientations, turning rates and accelerometers: scalar order, degrees, g. Never repaired."""

from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import Channel, Log
from nfc_gym.measured.channels import parse_channel
from nfc_gym.measured.findings import Severity, Suspicion
from nfc_gym.measured.smoothing import moving_average
from nfc_gym.physics.state import quat_conjugate, quat_multiply, quat_to_vector, rotate_back

Array = NDArray[np.float64]

FASTEST_GYRO = 40.0  # rad/s; the usual full scale is 2000 deg/s = 35 rad/s
TILT = 0.5  # rad; a machine that tilts further is looked at twice
TAKEN_OUT = 0.2  # of gravity; an accelerometer that reads less, in the median, is in free fall or has it subtracted
SLOW = 0.05  # rad/s; below this mean rate the scalar order cannot be told from the rates


def orientation(name: str, log: Log, scalar_last: bool) -> Iterator[Suspicion]:
    """Scalar first or last? Right is the reading whose rotation agrees with measured rates, or else keeps upright.

    Args:
      scalar_last: what the mapping declares; the log's own values are scalar first by that declaration.
    """
    where, body = f"channels.{name}", parse_channel(name).object
    declared = log.channels[name].values
    swapped = np.roll(declared, -1 if scalar_last else 1, axis=1)
    rates = _measured_rates(body, log)
    if rates is not None:
        wrong, other = (_rate_error(log, quat, *rates) for quat in (declared, swapped))
        if wrong > 0.5 and other < 0.5 * wrong:
            message = (
                f"its rotation is off the measured rates by {wrong:.0%}, with the other scalar order by {other:.0%}"
            )
            yield _order(where, "error", message)
            return
        if 0 < wrong < 0.5:
            return
    tilt, other = (float(np.percentile(_tilt(quat), 90)) for quat in (declared, swapped))
    if tilt > TILT and other < min(TILT, 0.5 * tilt):
        message = f"as declared the body tilts by {tilt:.2g} rad, with the other scalar order by {other:.2g} rad"
        yield _order(where, "error", message)
    elif np.median(np.abs(declared[:, 0])) < 0.2 and np.median(np.abs(declared[:, 3])) > 0.95:
        yield _order(
            where, "warning", "the body is turned by half a turn throughout, which scalar-last data would look like"
        )


def _order(where: str, severity: Severity, message: str) -> Suspicion:
    advice = "check `order`: wxyz is scalar first (MuJoCo), xyzw scalar last (ROS, scipy, Vicon)"
    return Suspicion(severity, where, "order", message, advice)


def _tilt(quat: Array) -> Array:
    """(T,) angle between the body's z axis and the world's, rad."""
    return np.arccos(np.clip(1 - 2 * (quat[:, 1] ** 2 + quat[:, 2] ** 2), -1, 1))


def _measured_rates(body: str, log: Log) -> tuple[Array, bool] | None:
    """(T, 3) measured angular velocity in rad/s and whether it is in the body's frame, where a channel measures it."""
    for name, channel in log.channels.items():
        if channel.values.shape != (len(log), 3) or channel.unit != "rad/s":
            continue
        parsed = parse_channel(name)
        if parsed.kind == "sensor" or (parsed.object == body and parsed.quantity == "angvel"):
            return channel.values, parsed.kind == "sensor" or parsed.own_frame
    return None


def _rate_error(log: Log, quat: Array, rates: Array, in_body: bool) -> float:
    """Distance of a quaternion's own rotation rate from the measured one, relative to that; 0 when hardly moving."""
    turn = quat_to_vector(quat_multiply(quat_conjugate(quat[:-1]), quat[1:]))
    own = moving_average(turn / np.diff(log.time)[:, None], 9)
    measured = moving_average(rates[:-1] if in_body else rotate_back(quat[:-1], rates[:-1]), 9)
    size = float(np.linalg.norm(measured))
    return float(np.linalg.norm(own - measured)) / size if size > SLOW * np.sqrt(len(measured)) else 0.0


def rate(name: str, channel: Channel) -> Iterator[Suspicion]:
    """An angular velocity in rad/s that no gyroscope could measure."""
    fast = float(np.percentile(np.abs(channel.values), 90))
    if fast > FASTEST_GYRO:
        message = f"turns at {fast:.4g} rad/s, faster than a gyroscope can measure: degrees/s for rad/s?"
        yield Suspicion("warning", f"channels.{name}", "degrees", message, "say `unit: deg/s` if so")


def gravity(name: str, sensor: str, channel: Channel, model: mujoco.MjModel) -> Iterator[Suspicion]:
    """An accelerometer whose reading in m/s^2 is about 1, gravity in g; or about 0, as if gravity were taken out."""
    s = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, sensor)
    if s < 0 or int(model.sensor_type[s]) != int(mujoco.mjtSensor.mjSENS_ACCELEROMETER):
        return
    values = channel.values.reshape(len(channel.values), -1)
    size = float(np.median(np.linalg.norm(values, axis=1)))
    if (values.shape[1] == 3 or channel.axes == (2,)) and 0.8 < size < 1.25:
        message = f"reads {size:.3g} m/s^2 where gravity is 9.81: in g?"
        yield Suspicion("error", f"channels.{name}", "g", message, "say `unit: g`")
    pull = float(np.linalg.norm(model.opt.gravity))
    if values.shape[1] == 3 and size < TAKEN_OUT * pull:
        message = f"reads {size:.2g} m/s^2 on the whole where gravity is {pull:.3g}: taken out of it?"
        advice = "name the raw reading, which at rest is gravity, upwards; unless the machine falls freely throughout"
        yield Suspicion("warning", f"channels.{name}", "gravity", message, advice)
