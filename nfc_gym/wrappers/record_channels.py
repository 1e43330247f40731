"""Which channels a log of a model has, how they are read off its state, and the model file that names them all."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.names import name_all, names
from nfc_gym.physics.state import rotate

Array = NDArray[np.float64]
_FREE, _SLIDE, _HINGE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{n}")) for n in ("FREE", "SLIDE", "HINGE"))
_SENSOR_UNITS = {
    "GYRO": "rad/s", "ACCELEROMETER": "m/s^2", "VELOCIMETER": "m/s", "FRAMEPOS": "m", "FRAMELINVEL": "m/s",
    "FRAMEANGVEL": "rad/s", "ACTUATORFRC": "N", "JOINTACTFRC": "N m",
    "TOUCH": "N", "FORCE": "N", "TORQUE": "N m",
}  # fmt: skip
# Orientations have no sensor channel, and these two would say a second time what the joints' channels say.
_SKIPPED = {"FRAMEQUAT", "BALLQUAT", "JOINTPOS", "JOINTVEL"}


@dataclass(frozen=True)
class Column:
    """One channel: its name, its SI unit, and where it lies in the state."""

    name: str
    unit: str
    kind: str
    at: int
    size: int = 1
    quat: int = 0


def columns(model: mujoco.MjModel) -> list[Column]:
    """Every channel of a model's state and sensors that a log can carry."""
    called, out = names(model), []
    for j, name in enumerate(called.joints):
        kind, q, v = int(model.jnt_type[j]), int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
        if kind in (_SLIDE, _HINGE):
            unit = "rad" if kind == _HINGE else "m"
            out += [
                Column(f"joint:{name}:pos", unit, "qpos", q),
                Column(f"joint:{name}:vel", f"{unit}/s", "qvel", v),
            ]
        elif kind == _FREE:
            body = called.bodies[int(model.jnt_bodyid[j])]
            out += [
                Column(f"body:{body}:pos", "m", "qpos", q, 3),
                Column(f"body:{body}:quat", "1", "quat", q + 3, 4),
                Column(f"body:{body}:linvel", "m/s", "qvel", v, 3),
                Column(f"body:{body}:angvel", "rad/s", "turning", v + 3, 3, q + 3),
            ]
    for s, name in enumerate(called.sensors):
        kind = mujoco.mjtSensor(int(model.sensor_type[s])).name.removeprefix("mjSENS_")
        if kind not in _SKIPPED:
            unit = _SENSOR_UNITS.get(kind, "1")
            out.append(Column(f"sensor:{name}", unit, "sensordata", int(model.sensor_adr[s]), int(model.sensor_dim[s])))
    return out


def values(column: Column, record: dict[str, Array]) -> Array:
    """(T, size) of one channel along a record of `qpos`, `qvel` and `sensordata`, (T, ...) each."""
    if column.kind == "quat":  # a state that was set by hand need not be of unit length; MuJoCo takes it as if it were
        quat = record["qpos"][:, column.at : column.at + 4]
        return quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    if column.kind == "turning":
        spin = record["qvel"][:, column.at : column.at + 3]
        quat = record["qpos"][:, column.quat : column.quat + 4]
        return rotate(quat / np.linalg.norm(quat, axis=-1, keepdims=True), spin)
    return record[column.kind][:, column.at : column.at + column.size]


def model_text(env: Any, model: mujoco.MjModel, given: str | None) -> str:
    """MJCF of an environment's nominal model in which everything that a log speaks of has a name.

    Raises:
      InputError: the environment's MJCF is not at hand, or is that of another model.
    """
    base = env.unwrapped
    holders = (base, *vars(base).values())
    own = getattr(base, "mjcf", None) if given is None else None  # asked once: it is written when asked for
    file = given or next((f for f in (getattr(h, "fullpath", None) for h in holders) if f and Path(f).is_file()), None)
    if isinstance(own, str):
        spec = mujoco.MjSpec.from_string(own)
    elif file is not None:
        spec = mujoco.MjSpec.from_file(str(file))
    else:
        raise InputError(f"RecordLog: the MJCF of {type(base).__name__} is not at hand: give its path as `model_file`")
    compiled = spec.compile()
    sizes = [(m.nq, m.nv, m.nu, m.nbody, m.nsensordata) for m in (compiled, model)]
    if sizes[0] != sizes[1]:
        raise InputError(
            f"RecordLog: {file} has (nq, nv, nu, nbody, nsensordata) = {sizes[0]}, the environment {sizes[1]}"
        )
    name_all(spec).compile()
    return spec.to_xml()
