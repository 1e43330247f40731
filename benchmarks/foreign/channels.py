"""What is logged of a machine: true values of channels, and what sensors and files make of them."""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from .effect import Array, Rng

# What a mapping file's unit is in SI.
UNITS = {
    "deg": np.pi / 180,
    "deg/s": np.pi / 180,
    "rpm": 2 * np.pi / 60,
    "mm": 1e-3,
    "cm": 1e-2,
    "ms": 1e-3,
    "us": 1e-6,
}


@dataclass(frozen=True)
class Channel:
    """A measured channel.

    Attributes:
      name, unit, order, rate: as in a mapping file.
      columns: of the log; several of a vector.
      noise: standard deviation of a sample, SI; of a quaternion that of its rotation, rad.
      count: what one count of an encoder is, SI; its values are whole counts, and its noise is not declared.
    """

    name: str
    columns: tuple[str, ...]
    unit: str
    noise: float
    order: str = ""
    rate: float = 0.0
    count: float = 0.0

    def sensed(self, true: Array, rng: Rng) -> Array:
        """What the sensor tells, SI: true values (T, k) to (T, k); a quaternion comes as wxyz and goes by `order`."""
        if self.order:
            out = true.copy()
            for quaternion, turn in zip(out, rng.normal(0, self.noise, (len(true), 3)), strict=True):
                mujoco.mju_quatIntegrate(quaternion, turn, 1.0)
            return out[:, [1, 2, 3, 0]] if self.order == "xyzw" else out
        if self.count:
            return np.round((true + rng.normal(0, self.count / 4, true.shape)) / self.count) * self.count
        return true + rng.normal(0, self.noise, true.shape)

    def entry(self) -> str:
        """The line of the mapping file."""
        said = [f"column: {self.columns[0]}" if len(self.columns) == 1 else f"columns: [{', '.join(self.columns)}]"]
        said += [f"order: {self.order}"] if self.order else [f"unit: {self.unit}"]
        said += [] if self.count else [f"noise: {self.noise / UNITS.get(self.unit, 1.0):.6g}"]
        said += [f"rate: {self.rate:g}"] if self.rate else []
        return f'  "{self.name}": {{{", ".join(said)}}}'


@dataclass(frozen=True)
class Control:
    """A commanded actuator: its column and the column's unit."""

    actuator: str
    column: str
    unit: str


@dataclass(frozen=True)
class Signal:
    """What is measured beside the motion and drives an effect; `draw` makes a log's course in time, SI."""

    name: str
    column: str
    unit: str
    noise: float
    draw: Callable[[Rng], Callable[[float], float]]


def true_value(model: mujoco.MjModel, data: mujoco.MjData, channel: str) -> Array:
    """A channel's true value (k,), by its name in a mapping file; quaternions as wxyz."""
    kind, name, *rest = channel.split(":")
    if kind == "joint":
        joint = data.joint(name)
        return np.array(joint.qpos if rest == ["pos"] else joint.qvel)
    if kind == "sensor":
        return np.array(data.sensor(name).data)
    joint = int(model.body_jntadr[model.body(name).id])  # the free joint of the body
    q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    if rest == ["linvel@body"]:
        axes = np.zeros(9)
        mujoco.mju_quat2Mat(axes, data.qpos[q + 3 : q + 7])
        return axes.reshape(3, 3).T @ data.qvel[v : v + 3]
    return {
        "pos": data.qpos[q : q + 3],
        "quat": data.qpos[q + 3 : q + 7],
        "linvel": data.qvel[v : v + 3],
        "angvel@body": data.qvel[v + 3 : v + 6],
    }[rest[0]].copy()


def joints(names: str, noise: float, unit: str = "rad", prefix: str = "") -> tuple[Channel, ...]:
    """Positions of joints, each in the column of its name."""
    return tuple(Channel(f"joint:{n}:pos", (prefix + n,), unit, noise) for n in names.split())


def speeds(names: str, noise: float, unit: str = "rad/s", prefix: str = "d_") -> tuple[Channel, ...]:
    """Speeds of joints, each in the column of its name with a prefix."""
    return tuple(Channel(f"joint:{n}:vel", (prefix + n,), unit, noise) for n in names.split())


def controls(names: str, unit: str, prefix: str = "u_") -> tuple[Control, ...]:
    """Actuators with one unit, each in the column of its name with a prefix."""
    return tuple(Control(n, prefix + n, unit) for n in names.split())
