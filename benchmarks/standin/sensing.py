"""Sensors that a stand-in may hide: of another scale, late, or mounted at an angle. Their noise stays what it was."""

from collections.abc import Sequence

import mujoco
import numpy as np

from nfc_gym.measured.hidden import Array, Hidden


class OnSensor(Hidden):
    """A sensor that tells something else than the truth of one channel, which is kept for every physics step."""

    def __init__(self, channel: str, columns: Sequence[str], values: dict[str, float], text: str) -> None:
        super().__init__((channel,), values, f"{channel} {text}")
        self.columns = tuple(columns)

    def begin(self, model: mujoco.MjModel) -> None:
        kind, name, quantity = self.where[0].split(":")
        joint = model.joint(name).id if kind == "joint" else int(model.body(name).jntadr[0])
        q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        first = {"pos": q, "quat": q + 3, "vel": v, "linvel": v, "angvel@body": v + 3}[quantity]
        self.place, self.of_q = slice(first, first + len(self.columns)), quantity in ("pos", "quat")
        self.past: list[Array] = []
        self.step = float(model.opt.timestep)

    def push(self, data: mujoco.MjData) -> None:
        self.past.append((data.qpos if self.of_q else data.qvel)[self.place].copy())

    def read(self, columns: dict[str, Array]) -> dict[str, Array]:
        time, true = columns["time"], np.array(self.past)
        often = round((time[1] - time[0]) / self.step)
        at = len(true) - often * np.arange(len(time), 0, -1)
        seen = np.stack([columns[c] for c in self.columns], 1)
        told = self.told(seen, true, at)
        return columns | {c: told[:, i] for i, c in enumerate(self.columns)}

    def told(self, seen: Array, true: Array, at: Array) -> Array:
        """(T, n) what the sensor tells.

        Args:
          seen: (T, n) what a good sensor tells, with its noise.
          true: (steps, n) the truth before each physics step.
          at: (T,) the steps at which it is asked.
        """
        raise NotImplementedError


class SensorGain(OnSensor):
    """A scale that is off: the sensor tells `gain` times the truth."""

    family = "sensor_gain"

    def __init__(self, channel: str, columns: Sequence[str], gain: float) -> None:
        super().__init__(channel, columns, {"gain": gain}, f"tells {gain:.4g} of the truth")

    def told(self, seen: Array, true: Array, at: Array) -> Array:
        return seen + (self.parameters["gain"] - 1) * true[at]


class SensorDelay(OnSensor):
    """A sensor that tells what was so a time ago."""

    family = "sensor_delay"

    def __init__(self, channel: str, columns: Sequence[str], delay: float) -> None:
        super().__init__(channel, columns, {"delay": delay}, f"is late by {1e3 * delay:.2f} ms")

    def told(self, seen: Array, true: Array, at: Array) -> Array:
        when = at - self.parameters["delay"] / self.step
        late = np.stack([np.interp(when, np.arange(len(true)), part) for part in true.T], 1)
        if len(self.columns) != 4:
            return seen + late - true[at]
        late /= np.linalg.norm(late, axis=1, keepdims=True)
        return _times(late, _times(true[at] * [1, -1, -1, -1], seen))  # the noise is a turn in the sensor's own frame


class Misalignment(OnSensor):
    """An attitude sensor that sits at an angle: it is turned against its body by the rotation vector (3,), rad."""

    family = "misalignment"

    def __init__(self, channel: str, columns: Sequence[str], turn: Array) -> None:
        values = dict(zip("xyz", map(float, turn), strict=True))
        super().__init__(channel, columns, values, f"is turned by {np.degrees(np.linalg.norm(turn)):.2f} degrees")
        self.turn = turn

    def told(self, seen: Array, true: Array, at: Array) -> Array:
        out = seen.copy()
        for quaternion in out:
            mujoco.mju_quatIntegrate(quaternion, self.turn, 1.0)
        return out


def _times(a: Array, b: Array) -> Array:
    """Products of quaternions (T, 4)."""
    out = np.empty_like(a)
    for product, left, right in zip(out, a, b, strict=True):
        mujoco.mju_mulQuat(product, left, right)
    return out
