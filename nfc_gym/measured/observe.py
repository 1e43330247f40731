"""What the channels of a log would show of a simulated trajectory, and how measurement and prediction differ."""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.fields import object_id
from nfc_gym.physics.segments import Trajectory
from nfc_gym.physics.state import quat_difference, rotate, rotate_back

Array = NDArray[np.float64]
_OBJ = mujoco.mjtObj
_TURNED = (int(mujoco.mjtSensor.mjSENS_FRAMEQUAT), int(mujoco.mjtSensor.mjSENS_BALLQUAT))
# quantity -> (report group, SI unit) for joints (hinge, slide) and for bodies
_JOINT = {"pos": (("joint angle", "rad"), ("position", "m")), "vel": (("joint speed", "rad/s"), ("velocity", "m/s"))}
_BODY = {
    "pos": ("position", "m"),
    "quat": ("orientation", "rad"),
    "linvel": ("velocity", "m/s"),
    "angvel": ("rotation rate", "rad/s"),
}


@dataclass(frozen=True)
class Observer:
    """One channel bound to a model.

    Attributes:
      name: the channel.
      group, unit: what reports call the quantity.
      size: numbers in its difference (3 for a quaternion).
      place: the joint, body or sensor, for reports.
    """

    name: str
    group: str
    unit: str
    size: int
    place: str
    _kind: str
    _address: int
    _address2: int = 0
    _in_body: bool = False
    _axes: tuple[int, ...] | None = None

    @property
    def quaternion(self) -> bool:
        """Whether the values are unit quaternions."""
        return self._kind in ("quat", "sensed quat")

    @property
    def needs_sensors(self) -> bool:
        """Whether prediction needs `sensordata`."""
        return self._kind in ("sensor", "sensed quat")

    def predict(self, traj: Trajectory) -> Array:
        """Values (P, S, K + 1, dim) along a trajectory; of a vector sensor all components (see `pick`)."""
        a = self._address
        if self._kind == "qpos":
            return traj.qpos[..., a : a + 1]
        if self._kind == "qvel":
            return traj.qvel[..., a : a + 1]
        if self.needs_sensors:
            assert traj.sensordata is not None
            return self.read(traj.sensordata)
        if self._kind == "pos":
            return traj.qpos[..., a : a + 3]
        quat = traj.qpos[..., self._address2 : self._address2 + 4]
        if self._kind == "quat":
            return quat
        velocity = traj.qvel[..., a : a + 3]
        if self._kind == "linvel":
            return rotate_back(quat, velocity) if self._in_body else velocity
        return velocity if self._in_body else rotate(quat, velocity)

    def read(self, sensordata: Array) -> Array:
        """A sensor's whole reading (..., dim) out of `sensordata`."""
        return sensordata[..., self._address : self._address + self._address2]

    def pick(self, values: Array) -> Array:
        """The components that are measured, after every effect on the whole sensor."""
        return values if self._axes is None else values[..., list(self._axes)]

    def difference(self, predicted: Array, measured: Array) -> Array:
        """measured minus predicted, (..., size); for quaternions the rotation vector, in the predicted frame."""
        return quat_difference(predicted, measured) if self.quaternion else measured - predicted


def _joint(model: mujoco.MjModel, name: str, joint: str, quantity: str) -> Observer:
    j = object_id(model, _OBJ.mjOBJ_JOINT, joint)
    kind = int(model.jnt_type[j])
    if kind < int(mujoco.mjtJoint.mjJNT_SLIDE):
        raise InputError(
            f"channel {name!r}: joint {joint!r} is a ball joint, which no channel measures"
            if kind == int(mujoco.mjtJoint.mjJNT_BALL)
            else f"channel {name!r}: joint {joint!r} is a free joint; use body:<name>:pos|quat|linvel|angvel"
        )
    if quantity not in _JOINT:
        raise InputError(f"channel {name!r} cannot be compared: want joint:<name>:pos or joint:<name>:vel")
    group, unit = _JOINT[quantity][0 if kind == int(mujoco.mjtJoint.mjJNT_HINGE) else 1]
    address = int(model.jnt_qposadr[j] if quantity == "pos" else model.jnt_dofadr[j])
    return Observer(name, group, unit, 1, f"joint:{joint}", "qpos" if quantity == "pos" else "qvel", address)


def _body(model: mujoco.MjModel, name: str, body: str, quantity: str) -> Observer:
    b = object_id(model, _OBJ.mjOBJ_BODY, body)
    first = int(model.body_jntadr[b])
    if first < 0 or int(model.jnt_type[first]) != int(mujoco.mjtJoint.mjJNT_FREE):
        raise InputError(
            f"channel {name!r}: body {body!r} has no free joint; "
            "measure it through joints or a frame sensor of the model"
        )
    in_body = quantity.endswith("@body")
    quantity = quantity.removesuffix("@body")
    if quantity not in _BODY:
        raise InputError(f"channel {name!r}: want one of {', '.join(_BODY)} of a body, optionally with @body")
    group, unit = _BODY[quantity]
    q, v = int(model.jnt_qposadr[first]), int(model.jnt_dofadr[first])
    address = {"pos": q, "quat": q + 3, "linvel": v, "angvel": v + 3}[quantity]
    return Observer(name, group, unit, 3, f"body:{body}", quantity, address, q + 3, in_body)


def observer(model: mujoco.MjModel, name: str, axes: tuple[int, ...] | None = None) -> Observer | None:
    """Bind a channel to a model; None for channels that are inputs of a prediction rather than compared.

    Such inputs are accelerations and forces.

    Raises:
      InputError: the model lacks the joint, body or sensor, or the quantity cannot be predicted.
    """
    kind, _, rest = name.partition(":")
    if kind == "force" or (kind == "joint" and name.endswith(":acc")):
        return None
    if kind == "sensor":
        s = object_id(model, _OBJ.mjOBJ_SENSOR, rest)
        size = int(model.sensor_dim[s])
        if is_orientation(model, s):
            address = int(model.sensor_adr[s])
            return Observer(name, f"sensor {rest}", "rad", 3, name, "sensed quat", address, size)
        return Observer(
            name,
            f"sensor {rest}",
            sensor_unit(model, s),
            len(axes) if axes else size,
            name,
            "sensor",
            int(model.sensor_adr[s]),
            size,
            False,
            axes,
        )
    place, _, quantity = rest.rpartition(":")
    if kind == "joint":
        return _joint(model, name, place, quantity)
    if kind == "body":
        return _body(model, name, place, quantity)
    raise InputError(
        f"channel {name!r}: want joint:<name>:pos|vel|acc, body:<name>:pos|quat|linvel|angvel, sensor:<name> "
        "or force:<actuator>"
    )


def is_orientation(model: mujoco.MjModel, sensor: int) -> bool:
    """Whether a sensor reads a unit quaternion, of which q and -q are the same orientation."""
    return int(model.sensor_type[sensor]) in _TURNED


def sensor_unit(model: mujoco.MjModel, sensor: int) -> str:
    """SI unit of a sensor's reading."""
    units = {
        "GYRO": "rad/s", "ACCELEROMETER": "m/s^2", "VELOCIMETER": "m/s",
        "FRAMEPOS": "m", "FRAMELINVEL": "m/s", "FRAMEANGVEL": "rad/s", "JOINTPOS": "rad", "JOINTVEL": "rad/s",
        "ACTUATORFRC": "N", "JOINTACTFRC": "N m", "TOUCH": "N", "FORCE": "N", "TORQUE": "N m",
    }  # fmt: skip
    return units.get(mujoco.mjtSensor(int(model.sensor_type[sensor])).name.removeprefix("mjSENS_"), "1")
