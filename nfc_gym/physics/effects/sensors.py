"""Sensors that report something else than the truth: bias, gain, delay, misalignment. `where` names channels.

A channel that the start state is read from carries its fault into that state: `true_state` takes it out again.
"""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Array, Effect, Scales, overrides
from nfc_gym.physics.effects.each import Each
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import sized
from nfc_gym.physics.fields import object_id
from nfc_gym.physics.state import quat_conjugate, quat_multiply, rotate, rotate_back, vector_to_quat

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
_OF_HINGE = {"pos": "rad", "vel": "rad/s", "acc": "rad/s^2"}
_OF_SLIDE = {"pos": "m", "vel": "m/s", "acc": "m/s^2"}
_OF_BODY = {"pos": "m", "linvel": "m/s", "angvel": "rad/s"}
# A free body's velocities in the order in which states take them: of several that are measured the first.
SPEEDS, RATES = ("linvel", "linvel@body"), ("angvel@body", "angvel")


@dataclass(frozen=True)
class Place:
    """A channel resolved against a model: its width, and where the state holds it (None where it does not)."""

    kind: str
    quantity: str
    dim: int
    q: int | None = None
    v: int | None = None


def _apart(channel: str) -> tuple[str, str, str]:
    """Kind, object and quantity of a channel; names may hold colons (`joint:robot0:knee:pos`)."""
    kind, _, rest = channel.partition(":")
    if kind not in ("joint", "body") or ":" not in rest:
        return kind, rest, ""
    name, _, quantity = rest.rpartition(":")
    return kind, name, quantity


def resolve_channel(model: mujoco.MjModel, channel: str) -> Place:
    """Width and place in the state of a channel; an unknown object raises `InputError`."""
    kind, name, quantity = _apart(channel)
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
        joint = object_id(model, mujoco.mjtObj.mjOBJ_JOINT, _apart(channel)[1])
        slides = int(model.jnt_type[joint]) == _SLIDE
        return (_OF_SLIDE if slides else _OF_HINGE).get(quantity, "1")
    return _OF_BODY.get(quantity, "1") if at.kind == "body" else "1"


class _OnChannel(Effect):
    """What the faults share: channels, resolved; each has the fault.

    A fault changes what is measured at a moment and, with it, the slope that the measurements have there (of an
    orientation the rate in its own frame): a speed that no channel of its own measures is such a slope.
    """

    def bind(self, model: mujoco.MjModel) -> None:
        self.at = {channel: resolve_channel(model, channel) for channel in self.where}
        for channel, at in self.at.items():
            if not self.fits(at):
                raise InputError(
                    f"{self.family} of {channel!r} with {', '.join(p.name for p in self.params)}: the channel has "
                    f"{'the four numbers of an orientation' if at.quantity == 'quat' else f'{at.dim} number(s)'}; "
                    f"{self.WANTED}"
                )

    WANTED = "any channel will do"

    def fits(self, at: Place) -> bool:
        """Whether such a channel can have the fault; `WANTED` says which can."""
        return True

    def slope(self, slope: Array, theta: Array) -> Array:
        """True slope of a channel (..., dim), of an orientation (..., 3) -> the slope of what is measured."""
        return slope

    def undo(self, channel: str, value: Array, slope: Array, theta: Array) -> tuple[Array, Array]:
        """What is measured at a moment (..., dim) and its slope -> what they truly are."""
        raise NotImplementedError

    def unsense(self, q: Array, v: Array, theta: Array) -> tuple[Array, Array]:
        return true_state((self,), (theta,), q, v)

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

    WANTED = "want `bias` of numbers that are no orientation, or `x`, `y` and `z` of a vector"

    def fits(self, at: Place) -> bool:
        return at.quantity != "quat" and len(self.params) in (1, at.dim)

    def sense(self, channel: str, values: Array, theta: Array, dt: float) -> Array:
        return values + theta[..., None, :] if channel in self.where else values

    def undo(self, channel: str, value: Array, slope: Array, theta: Array) -> tuple[Array, Array]:
        return value - theta, slope

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
    WANTED = "want numbers that are no orientation"

    def fits(self, at: Place) -> bool:
        return at.quantity != "quat"

    def sense(self, channel: str, values: Array, theta: Array, dt: float) -> Array:
        return values * theta[..., None, :] if channel in self.where else values

    def slope(self, slope: Array, theta: Array) -> Array:
        return slope * theta

    def undo(self, channel: str, value: Array, slope: Array, theta: Array) -> tuple[Array, Array]:
        return value / theta, slope / theta

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        return [cls((channel,), cls.PARAMS) for channel, *_ in cls._channels(model, scales)]


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

    def undo(self, channel: str, value: Array, slope: Array, theta: Array) -> tuple[Array, Array]:
        since = theta[..., :1] * slope
        if self.at[channel].quantity == "quat":
            return quat_multiply(value, vector_to_quat(since)), slope
        return value + since, slope

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        size = {"probes": (max(scales.interval, 0.01),), "resolution": 0.05 * scales.interval}
        return [cls((channel,), sized(cls.PARAMS, delay=size)) for channel in scales.channels]


class Misalignment(_OnChannel):
    """A sensor mounted turned by the rotation vector (x, y, z); vectors and orientation are read in that frame."""

    family = "misalignment"
    summary = "Sensor mounted at an angle"
    PARAMS = tuple(Param(axis, "rad", -0.3, 0.3, probes=(0.03,), resolution=5e-4) for axis in "xyz")

    WANTED = "want an orientation or a vector"

    def fits(self, at: Place) -> bool:
        return at.dim in (3, 4)

    def sense(self, channel: str, values: Array, theta: Array, dt: float) -> Array:
        if channel not in self.where:
            return values
        mount = vector_to_quat(theta)[..., None, :]
        if self.at[channel].dim == 4:
            return quat_multiply(values, np.broadcast_to(mount, values.shape))
        return rotate(np.broadcast_to(quat_conjugate(mount), (*values.shape[:-1], 4)), values)

    def slope(self, slope: Array, theta: Array) -> Array:
        return rotate_back(_alike(vector_to_quat(theta), slope), slope)

    def undo(self, channel: str, value: Array, slope: Array, theta: Array) -> tuple[Array, Array]:
        mount = vector_to_quat(theta)
        slope = rotate(_alike(mount, slope), slope)
        if self.at[channel].quantity == "quat":
            return quat_multiply(value, _alike(quat_conjugate(mount), value)), slope
        return rotate(_alike(mount, value), value), slope

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for channel in scales.channels:
            at = resolve_channel(model, channel)
            if at.dim == 4 or (at.dim == 3 and at.kind == "sensor"):
                out.append(cls((channel,), cls.PARAMS))
        return out


def _alike(quat: Array, vectors: Array) -> Array:
    """Quaternions (..., 4), one for each of vectors (..., n)."""
    return np.broadcast_to(quat, (*vectors.shape[:-1], 4))


def true_state(
    effects: Sequence[Effect],
    thetas: Sequence[Array],
    q: Array,
    v: Array,
    channels: Collection[str] | None = None,
    a: Array | None = None,
) -> tuple[Array, Array]:
    """The state that faulty sensors were measuring, from the state that was read from them as if they were right.

    The faults of each channel are undone in reverse order, and in what was computed from the channel as well: in a
    speed that no other channel measures, in velocities that were turned by a faulty orientation. What the speed of a
    joint or of a free body's place has changed by since a late sensor measured it is told by accelerations; without
    them, and of rotations, it is not known.

    Args:
      effects: in the order in which their `sense` acts; those that are no faults of sensors act by their `unsense`.
      thetas: the parameters of each, (..., k).
      q, v: (..., nq), (..., nv).
      channels: names of all that was measured; None takes it to be the channels that have a fault, and no others.
      a: (..., nv) how fast the speeds changed.
    """
    faults: dict[str, list[tuple[_OnChannel, Array]]] = {}
    for effect, theta in zip(effects, thetas, strict=True):
        for part, own in effect.apart(theta) if isinstance(effect, Each) else [(effect, theta)]:
            if isinstance(part, _OnChannel):
                for channel in part.where:
                    faults.setdefault(channel, []).append((part, own))
            elif overrides(part, "unsense"):
                q, v = part.unsense(q, v, own)
    if not faults:
        return q, v
    q, v = np.array(q), np.array(v)
    sensors = _Sensors(faults, faults if channels is None else channels)
    places = {channel.rpartition(":")[0]: of[0][0].at[channel] for channel, of in faults.items()}
    for name, at in places.items():
        if at.q is not None and at.v is not None:
            course = None if a is None else a[..., at.v :]
            (sensors.joint if at.kind == "joint" else sensors.body)(name, q[..., at.q :], v[..., at.v :], course)
    return q, v


@dataclass(frozen=True)
class _Sensors:
    """All channels that were measured, and the faults of those that have some, in the order in which they act."""

    faults: Mapping[str, Sequence[tuple[_OnChannel, Array]]]
    channels: Collection[str]

    def _first(self, place: str, kinds: Sequence[str]) -> str | None:
        return next((c for kind in kinds if (c := f"{place}:{kind}") in self.channels), None)

    def _slope(self, channel: str | None, slope: Array) -> Array:
        for fault, theta in self.faults.get(channel or "", ()):
            slope = fault.slope(slope, theta)
        return slope

    def _undo(self, channel: str | None, value: Array, slope: Array) -> tuple[Array, Array]:
        for fault, theta in reversed(self.faults.get(channel or "", ())):
            value, slope = fault.undo(channel or "", value, slope, theta)
        return value, slope

    def _placed(
        self, channel: str | None, speed: str | None, at: Array, shown: Array, course: Array | None
    ) -> tuple[Array, Array]:
        """True position (..., n) and velocity, from the measured position and the velocity that the state has.

        The latter is the true one where a channel `speed` measures it, and else the slope of the positions, which is as
        late as these.

        Args:
          course: how fast that velocity changes; None where nobody knows.
        """
        late = self._late(channel)
        bent = 0.0 if course is None else late**2 / 2 * course
        if speed is not None:
            return self._undo(channel, at, self._slope(channel, shown))[0] - bent, shown
        value, slope = self._undo(channel, at, shown)
        return value + bent, slope if course is None else slope + late * course

    def _late(self, channel: str | None) -> Array:
        """(..., 1) by how much a channel is late, s."""
        delays = [
            theta[..., :1] for fault, theta in self.faults.get(channel or "", ()) if fault.family == "sensor_delay"
        ]
        return np.asarray(sum(delays, np.zeros(1)))

    def _speed(self, channel: str | None, shown: Array, course: Array | None = None) -> Array:
        return self._undo(channel, shown, np.zeros_like(shown) if course is None else course)[0]

    def joint(self, place: str, q: Array, v: Array, a: Array | None = None) -> None:
        """A joint's state (..., 1 and more), in place; `a` is how fast its speed changes."""
        speed, course = self._first(place, ("vel",)), None if a is None else a[..., :1]
        known = self._speed(speed, v[..., :1], course)
        q[..., :1], v[..., :1] = self._placed(self._first(place, ("pos",)), speed, q[..., :1], known, course)

    def body(self, place: str, q: Array, v: Array, a: Array | None = None) -> None:
        """A free body's state (..., 7 and more), (..., 6 and more), in place; `a` is how fast its speeds change."""
        course = None if a is None else a[..., :3]
        speed, rates, attitude = (self._first(place, kinds) for kinds in (SPEEDS, RATES, ("quat",)))
        seen, turning = q[..., 3:7].copy(), v[..., 3:6].copy()
        # Where a state turned what was measured, only the difference is turned: where there is none, no bit changes.
        if rates and not rates.endswith("@body"):
            raw = rotate(seen, turning)
            slope = turning + (rotate_back(seen, self._speed(rates, raw)) - rotate_back(seen, raw))
        else:
            slope = self._slope(attitude if rates else None, self._speed(rates, turning))
        q[..., 3:7], v[..., 3:6] = self._undo(attitude, seen, slope)
        if speed and speed.endswith("@body"):
            raw = rotate_back(seen, v[..., :3])
            known = v[..., :3] + (rotate(q[..., 3:7], self._speed(speed, raw)) - rotate(seen, raw))
        else:
            known = self._speed(speed, v[..., :3], course)
        q[..., :3], v[..., :3] = self._placed(self._first(place, ("pos",)), speed, q[..., :3], known, course)
