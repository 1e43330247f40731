"""Sensors that report something else than the truth: bias, gain, delay, misalignment. `where` names channels.

A channel that the start state is read from carries its fault into that state: `unsense` takes it out again.
"""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from dataclasses import dataclass

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Array, Effect, Param, Scales
from nfc_gym.physics.effects.places import sized
from nfc_gym.physics.fields import object_id
from nfc_gym.physics.state import quat_conjugate, quat_multiply, rotate, vector_to_quat

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
_OF_HINGE = {"pos": "rad", "vel": "rad/s", "acc": "rad/s^2"}
_OF_SLIDE = {"pos": "m", "vel": "m/s", "acc": "m/s^2"}
_OF_BODY = {"pos": "m", "linvel": "m/s", "angvel": "rad/s"}


@dataclass(frozen=True)
class Place:
    """A channel resolved against a model: its width, and where the state holds it (None where it does not)."""

    kind: str
    quantity: str
    dim: int
    q: int | None = None
    v: int | None = None


def resolve_channel(model: mujoco.MjModel, channel: str) -> Place:
    """Width and place in the state of a channel; an unknown object raises `InputError`."""
    kind, _, rest = channel.partition(":")
    name, _, quantity = rest.partition(":")
    if kind == "joint":
        joint = object_id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
        return Place(kind, quantity, 1, int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint]))
    if kind == "body":
        body = object_id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        joint = int(model.body_jntadr[body])
        dim = 4 if quantity == "quat" else 3
        if joint < 0 or int(model.jnt_type[joint]) != _FREE:
            return Place(kind, quantity, dim)
        return Place(kind, quantity, dim, int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint]))
    if kind == "sensor":
        return Place(kind, "", int(model.sensor_dim[object_id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)]))
    if kind == "force":
        object_id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name)
        return Place(kind, "", 1)
    raise InputError(f"channel {channel!r}: want joint:<name>:..., body:<name>:..., sensor:<name> or force:<actuator>")


def unit_of(model: mujoco.MjModel, channel: str) -> str:
    """Unit of what a channel reports, `1` where the name does not say."""
    at = resolve_channel(model, channel)
    quantity = at.quantity.partition("@")[0]
    if at.kind == "joint":
        joint = object_id(model, mujoco.mjtObj.mjOBJ_JOINT, channel.split(":")[1])
        slides = int(model.jnt_type[joint]) == _SLIDE
        return (_OF_SLIDE if slides else _OF_HINGE).get(quantity, "1")
    return _OF_BODY.get(quantity, "1") if at.kind == "body" else "1"


class _OnChannel(Effect):
    """What the faults share: channels, resolved; each has the fault."""

    def bind(self, model: mujoco.MjModel) -> None:
        self.at = {channel: resolve_channel(model, channel) for channel in self.where}

    def unsense(self, q: Array, v: Array, theta: Array) -> tuple[Array, Array]:
        for channel in self.where:
            q, v = self.undo(channel, q, v, theta)
        return q, v

    def undo(self, channel: str, q: Array, v: Array, theta: Array) -> tuple[Array, Array]:
        """`unsense` for one channel."""
        raise NotImplementedError

    @staticmethod
    def _channels(model: mujoco.MjModel, scales: Scales) -> list[tuple[str, Place, float, float]]:
        """(channel, place, spread, noise) of every measured channel of one or three numbers but world positions."""
        out = []
        for channel, (spread, noise) in scales.channels.items():
            at = resolve_channel(model, channel)
            if at.dim in (1, 3) and not (at.kind == "body" and at.quantity == "pos"):
                out.append((channel, at, max(spread, noise, 1e-9), noise))
        return out


class SensorBias(_OnChannel):
    """A constant added to what is measured, for each axis."""

    family = "sensor_bias"
    summary = "Sensor bias"
    PARAMS = (Param("bias", "1", -1e6, 1e6, probes=(0.01,)),)
    ON_VECTOR = tuple(Param(axis, "1", -1e6, 1e6, probes=(0.01,)) for axis in "xyz")

    @classmethod
    def declare(cls, names: tuple[str, ...]) -> tuple[Param, ...]:  # type: ignore[override]
        return cls.ON_VECTOR if set(names) == set("xyz") else super().declare(names)

    def sense(self, channel: str, values: Array, theta: Array, dt: float) -> Array:
        return values + theta[..., None, :] if channel in self.where else values

    def undo(self, channel: str, q: Array, v: Array, theta: Array) -> tuple[Array, Array]:
        at = self.at[channel]
        if at.kind == "joint" and at.quantity in ("pos", "vel"):
            q, v = np.array(q), np.array(v)
            target, column = (q, at.q) if at.quantity == "pos" else (v, at.v)
            target[..., column] -= theta[..., 0]
        elif at.kind == "body" and at.quantity == "linvel" and at.v is not None:
            v = np.array(v)
            v[..., at.v : at.v + 3] -= theta
        elif at.kind == "body" and at.quantity == "angvel@body" and at.v is not None:
            v = np.array(v)
            v[..., at.v + 3 : at.v + 6] -= theta
        return q, v

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for channel, at, spread, noise in cls._channels(model, scales):
            params = cls.PARAMS if at.dim == 1 else cls.ON_VECTOR
            size = {
                "probes": (0.1 * spread + noise,),
                # a bias larger than all that was ever measured would have been seen on the bench
                "low": -spread,
                "high": spread,
                "resolution": 2e-3 * spread,
            }
            size["unit"] = unit_of(model, channel)
            out.append(cls((channel,), sized(params, **{p.name: size for p in params})))
        return out


class SensorGain(_OnChannel):
    """What is measured times `gain`."""

    family = "sensor_gain"
    summary = "Sensor gain"
    PARAMS = (Param("gain", "1", 0.3, 3.0, null=1.0, probes=(1.05,), resolution=1e-3, floor=-np.inf),)
    # A joint whose speed is not measured has its speed from the position channel, and with it the gain.
    with_speed = True

    def sense(self, channel: str, values: Array, theta: Array, dt: float) -> Array:
        return values * theta[..., None, :] if channel in self.where else values

    def undo(self, channel: str, q: Array, v: Array, theta: Array) -> tuple[Array, Array]:
        at = self.at[channel]
        if at.kind == "joint" and at.quantity in ("pos", "vel"):
            q, v = np.array(q), np.array(v)
            if at.quantity == "pos":
                q[..., at.q] /= theta[..., 0]
            alone = f"{channel.removesuffix(':pos')}:vel" not in self.where
            if at.quantity == "vel" or (self.with_speed and alone):
                v[..., at.v] /= theta[..., 0]
        elif at.kind == "body" and at.quantity in ("linvel", "angvel@body", "angvel") and at.v is not None:
            v = np.array(v)
            first = at.v + (0 if at.quantity == "linvel" else 3)
            v[..., first : first + 3] /= theta
        return q, v

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for channel, at, _, _ in cls._channels(model, scales):
            effect = cls((channel,), cls.PARAMS)
            if at.kind == "joint" and at.quantity == "pos":
                effect.with_speed = f"{channel.removesuffix(':pos')}:vel" not in scales.channels
            out.append(effect)
        return out


class SensorDelay(_OnChannel):
    """The channel reports what was `delay` ago; before the first sample the trajectory goes on in a straight line."""

    family = "sensor_delay"
    summary = "Delayed sensor"
    PARAMS = (Param("delay", "s", 0.0, 0.5, probes=(0.02,)),)

    def sense(self, channel: str, values: Array, theta: Array, dt: float) -> Array:
        if channel not in self.where:
            return values
        count = values.shape[-2]
        when = np.arange(count) - theta[..., :1] / dt
        before = np.clip(np.floor(when), 0, max(count - 2, 0)).astype(np.intp)
        # The last sample lies at a whole index: reading it as "before plus one step" would not be exact without delay.
        before = np.where(when >= count - 1, count - 1, before)
        after = np.minimum(before + 1, count - 1)
        here = np.take_along_axis(values, np.broadcast_to(before[..., None], values.shape), -2)
        there = np.take_along_axis(values, np.broadcast_to(after[..., None], values.shape), -2)
        return here + (when - before)[..., None] * (there - here)

    def undo(self, channel: str, q: Array, v: Array, theta: Array) -> tuple[Array, Array]:
        at = self.at[channel]
        if at.q is None or at.v is None or at.quantity not in ("pos", "quat"):
            return q, v
        q = np.array(q)
        late = theta[..., :1]
        if at.kind == "joint":
            q[..., at.q : at.q + 1] += late * v[..., at.v : at.v + 1]
        elif at.quantity == "pos":
            q[..., at.q : at.q + 3] += late * v[..., at.v : at.v + 3]
        else:
            turn = vector_to_quat(late * v[..., at.v + 3 : at.v + 6])
            quat = q[..., at.q + 3 : at.q + 7]
            q[..., at.q + 3 : at.q + 7] = quat_multiply(quat, turn)
        return q, v

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        size = {"probes": (max(scales.interval, 0.01),), "resolution": 0.05 * scales.interval}
        return [cls((channel,), sized(cls.PARAMS, delay=size)) for channel in scales.channels]


class Misalignment(_OnChannel):
    """A sensor mounted turned by the rotation vector (x, y, z); vectors and orientation are read in that frame."""

    family = "misalignment"
    summary = "Sensor mounted at an angle"
    PARAMS = tuple(Param(axis, "rad", -0.3, 0.3, probes=(0.03,), resolution=5e-4) for axis in "xyz")

    def sense(self, channel: str, values: Array, theta: Array, dt: float) -> Array:
        if channel not in self.where:
            return values
        mount = vector_to_quat(theta)[..., None, :]
        if self.at[channel].dim == 4:
            return quat_multiply(values, np.broadcast_to(mount, values.shape))
        return rotate(np.broadcast_to(quat_conjugate(mount), (*values.shape[:-1], 4)), values)

    def undo(self, channel: str, q: Array, v: Array, theta: Array) -> tuple[Array, Array]:
        at = self.at[channel]
        if at.kind != "body" or at.q is None or at.v is None:
            return q, v
        mount = vector_to_quat(theta)
        if at.quantity == "quat":
            q = np.array(q)
            quat = q[..., at.q + 3 : at.q + 7]
            q[..., at.q + 3 : at.q + 7] = quat_multiply(quat, np.broadcast_to(quat_conjugate(mount), quat.shape))
        elif at.quantity in ("linvel", "angvel@body"):
            v = np.array(v)
            first = at.v + (0 if at.quantity == "linvel" else 3)
            part = v[..., first : first + 3]
            v[..., first : first + 3] = rotate(np.broadcast_to(mount, (*part.shape[:-1], 4)), part)
        return q, v

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for channel in scales.channels:
            at = resolve_channel(model, channel)
            if at.dim == 4 or (at.dim == 3 and at.kind == "sensor"):
                out.append(cls((channel,), cls.PARAMS))
        return out
