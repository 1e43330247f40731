"""States of the model along a log, from whatever channels measure them, with the uncertainty that measuring leaves."""

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Channel, Log
from nfc_gym.measured.channels import parse_channel
from nfc_gym.measured.smoothing import POINTS, Local, centred_average, estimate_noise, fresh_samples, local_polynomial
from nfc_gym.physics.effects.sensors import RATES, SPEEDS
from nfc_gym.physics.state import quat_conjugate, quat_multiply, quat_to_vector, rotate, rotate_back, vector_to_quat

Array = NDArray[np.float64]
# Standard deviations of the declared noise by which a channel's fit is off what was measured, from which on the motion
# is one that a polynomial does not follow, as a wheel's speed that is another after each command.
_FAR = 5.0
_BENT = 5  # degree of the polynomials that slopes are taken from there
_FEWEST = 8  # rows of a channel from which its course is told without those that are masked
_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)


@dataclass(frozen=True)
class States:
    """Estimated states on a log's own time grid.

    Attributes:
      qpos, qvel, qacc: (T, nq), (T, nv), (T, nv).
      qpos_sd, qvel_sd: (T, nv) standard deviations in tangent space; 0 for what was never measured and is taken as at
        rest.
      observed: (nv,) whether the degree of freedom was measured at all.
    """

    qpos: Array
    qvel: Array
    qacc: Array
    qpos_sd: Array
    qvel_sd: Array
    observed: NDArray[np.bool_]


def channel_noise(log: Log, name: str) -> float:
    """Noise of a channel: as declared, else estimated from the log's high frequencies; of attitudes in rad."""
    channel = log.channels[name]
    if channel.noise is not None:
        return channel.noise
    values = channel.values[fresh_samples(log.time, channel.values, channel.rate)]
    return estimate_noise(_turned(values) if _turns(name, values) else values)


def _turns(name: str, values: Array) -> bool:
    """Whether a channel is an orientation's: a body's, or that of a sensor whose four numbers have a norm of 1."""
    parsed = parse_channel(name)
    four = parsed.kind == "sensor" and values.ndim == 2 and values.shape[1] == 4
    return parsed.quantity == "quat" or (four and bool(np.allclose(np.linalg.norm(values, axis=1), 1, atol=1e-6)))


def _measured(log: Log, channel: Channel) -> NDArray[np.intp]:
    """Rows that hold a measurement of their own: renewed, and not masked; all renewed ones where hardly any is left."""
    index = fresh_samples(log.time, channel.values, channel.rate)
    kept = index if channel.mask is None else index[channel.mask[index]]
    return kept if len(kept) >= _FEWEST else index


def _turned(quat: Array) -> Array:
    """(n, 3) body-frame increments of rotation (n, 4), added up: the noise of a vector has the size of its angle's."""
    unit = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    steps = quat_to_vector(quat_multiply(quat_conjugate(unit[:-1]), unit[1:]))
    # They add up to a curve whose slope is the body-frame rate to second order in the step.
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, 0)])


def _smooth(log: Log, channel: Channel, values: Array, points: int, raw: bool) -> Local:
    index, wide = _measured(log, channel), values.reshape(len(log), -1)
    fit = local_polynomial(log.time[index], wide[index], log.time, points)
    if channel.mask is None and len(index) < len(log):
        return fit
    off = float(np.sqrt(np.square(wide[index] - fit.value[index]).mean()))
    if not raw and (channel.noise is None or off <= _FAR * channel.noise):
        return fit
    if not raw and channel.noise:  # slopes of a curve that bends more; what it is off still, they are off too
        fit = local_polynomial(log.time[index], wide[index], log.time, points, _BENT)
        fit = replace(fit, slope_gain=fit.slope_gain * np.maximum(1.0, fit.misfit / channel.noise))
    value, gain = fit.value.copy(), fit.value_gain.copy()
    value[index] = wide[index]
    if not raw:
        gain[index] = 1.0
    return replace(fit, value=value, value_gain=gain)


def _averaged(log: Log, channel: Channel) -> Array:
    """(T,) a channel's moving average of the declared width; rows that are masked take the course between others."""
    values = channel.values
    if channel.mask is not None and not channel.mask.all() and channel.mask.any():
        values = np.interp(log.time, log.time[channel.mask], values[channel.mask])
    return centred_average(values, channel.smooth)


class _Builder:
    def __init__(self, model: mujoco.MjModel, log: Log, points: int, raw: bool) -> None:
        self.model, self.log, self.points, self.raw = model, log, points, raw
        rows = len(log)
        self.qpos = np.tile(model.qpos0, (rows, 1))
        self.qvel, self.qacc = np.zeros((rows, model.nv)), np.zeros((rows, model.nv))
        self.qpos_sd, self.qvel_sd = np.zeros((rows, model.nv)), np.zeros((rows, model.nv))
        self.observed = np.zeros(model.nv, bool)

    def get(self, *names: str) -> tuple[str, Channel] | None:
        for name in names:
            if name in self.log.channels:
                return name, self.log.channels[name]
        return None

    def scalar(self, name: str, q: int, v: int) -> None:
        """A hinge or slide joint."""
        position, speed = self.get(f"joint:{name}:pos"), self.get(f"joint:{name}:vel")
        acceleration = self.get(f"joint:{name}:acc")
        self.observed[v] = position is not None or speed is not None
        if position is not None:
            key, channel = position
            noise, fit = channel_noise(self.log, key), _smooth(self.log, channel, channel.values, self.points, self.raw)
            self.qpos[:, q], self.qpos_sd[:, v] = fit.value[:, 0], noise * fit.value_gain
            self.qvel[:, v], self.qvel_sd[:, v] = fit.slope[:, 0], noise * fit.slope_gain
            self.qacc[:, v] = fit.curvature[:, 0]
        if speed is not None:
            key, channel = speed
            noise, fit = channel_noise(self.log, key), _smooth(self.log, channel, channel.values, self.points, self.raw)
            self.qvel[:, v], self.qvel_sd[:, v], self.qacc[:, v] = (
                fit.value[:, 0],
                noise * fit.value_gain,
                fit.slope[:, 0],
            )
            if position is None:
                steps = np.diff(self.log.time) * (self.qvel[1:, v] + self.qvel[:-1, v]) / 2
                self.qpos[:, q] = self.model.qpos0[q] + np.concatenate([[0], np.cumsum(steps)])
        if acceleration is not None:
            self.qacc[:, v] = _averaged(self.log, acceleration[1])

    def free(self, body: str, q: int, v: int) -> None:
        """A free joint: position and world velocity, quaternion and body-frame rates."""
        position, attitude = self.get(f"body:{body}:pos"), self.get(f"body:{body}:quat")
        speed, rates = (self.get(*(f"body:{body}:{kind}" for kind in kinds)) for kinds in (SPEEDS, RATES))
        self.observed[v : v + 3] = position is not None or speed is not None
        self.observed[v + 3 : v + 6] = attitude is not None or rates is not None
        if attitude is not None:
            self._attitude(attitude, q, v)
        if rates is not None:
            key, channel = rates
            values = (
                channel.values if key.endswith("@body") else rotate_back(self.qpos[:, q + 3 : q + 7], channel.values)
            )
            self._vector(key, channel, values, v + 3)
        if position is not None:
            key, channel = position
            noise, fit = channel_noise(self.log, key), _smooth(self.log, channel, channel.values, self.points, self.raw)
            self.qpos[:, q : q + 3], self.qpos_sd[:, v : v + 3] = fit.value, noise * fit.value_gain[:, None]
            self.qvel[:, v : v + 3], self.qvel_sd[:, v : v + 3] = fit.slope, noise * fit.slope_gain[:, None]
            self.qacc[:, v : v + 3] = fit.curvature
        if speed is not None:
            key, channel = speed
            values = rotate(self.qpos[:, q + 3 : q + 7], channel.values) if key.endswith("@body") else channel.values
            self._vector(key, channel, values, v)

    def _vector(self, key: str, channel: Channel, values: Array, v: int) -> None:
        noise, fit = channel_noise(self.log, key), _smooth(self.log, channel, values, self.points, self.raw)
        self.qvel[:, v : v + 3], self.qvel_sd[:, v : v + 3] = fit.value, noise * fit.value_gain[:, None]
        self.qacc[:, v : v + 3] = fit.slope

    def _attitude(self, attitude: tuple[str, Channel], q: int, v: int) -> None:
        """Smooth a quaternion as a rotation vector about the nearest sample."""
        key, channel = attitude
        quat = channel.values / np.linalg.norm(channel.values, axis=1, keepdims=True)
        noise = channel_noise(self.log, key)
        index = _measured(self.log, channel)
        vectors = np.zeros((len(quat), 3))
        vectors[index] = _turned(quat[index])
        fit = _smooth(self.log, channel, vectors, self.points, self.raw)
        hold = index[np.maximum(np.searchsorted(index, np.arange(len(quat)), side="right") - 1, 0)]
        self.qpos[:, q + 3 : q + 7] = quat_multiply(quat[hold], vector_to_quat(fit.value - vectors[hold]))
        self.qpos_sd[:, v + 3 : v + 6] = noise * fit.value_gain[:, None]
        self.qvel[:, v + 3 : v + 6], self.qvel_sd[:, v + 3 : v + 6] = fit.slope, noise * fit.slope_gain[:, None]
        self.qacc[:, v + 3 : v + 6] = fit.curvature


def estimate_states(model: mujoco.MjModel, log: Log, points: int = POINTS, raw: bool = False) -> States:
    """States along a log by local cubic fits to the channels that measure them.

    Args:
      points: samples in each local fit.
      raw: take what was measured as it is, noise and all; what was not measured still comes from the fits.

    Raises:
      InputError: no channel of the log measures any degree of freedom of the model.
    """
    build = _Builder(model, log, points, raw)
    for j in range(model.njnt):
        q, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
        kind = int(model.jnt_type[j])
        if kind == _FREE:
            build.free(mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, int(model.jnt_bodyid[j])), q, v)
        elif kind != _BALL:
            build.scalar(mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, j), q, v)
    if not build.observed.any():
        raise InputError(
            f"log {log.name!r}: none of its channels ({', '.join(log.channels)}) measures a joint or a free body "
            "of the model"
        )
    return States(build.qpos, build.qvel, build.qacc, build.qpos_sd, build.qvel_sd, build.observed)
