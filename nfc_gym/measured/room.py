"""What each actuator may be commanded, in a proposal: its range, and the command at which a recording begins."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Log
from nfc_gym.measured.bench import Bench
from nfc_gym.physics.effects.drive import is_position
from nfc_gym.physics.effects.lookup import actuator_names

Array = NDArray[np.float64]
_ADDED = 0.2  # of an actuator's room that a feed-forward may use: the rest is the controller's


@dataclass(frozen=True)
class Room:
    """What each control may be commanded: `low`, `rest`, `high` (nu,) in SI; `names` as the mapping has them."""

    names: tuple[str, ...]
    low: Array
    rest: Array
    high: Array

    def commands(self, w: Array) -> Array:
        """Commands (..., nu) at w in -1..1, 0 being the resting command."""
        return self.rest + np.where(w > 0, w * (self.high - self.rest), w * (self.rest - self.low))

    def additions(self, w: Array) -> Array:
        """The same as changes to a controller's commands, symmetric about none."""
        return _ADDED * w * (self.high - self.low) / 2


def let_go(bench: Bench, room: Room) -> Room:
    """The same with forces and speeds commanded to 0 at rest; goals of positions stay as they were.

    A log that begins in mid-motion begins with a command that drives.
    """
    model, entries = bench.plant.model, bench.dataset.mapping.controls
    actuators = [actuator_names(model).index(name.removeprefix("ctrl:")) for name in room.names]
    goal = [
        entries[name].servo is not None or is_position(model, a) for name, a in zip(room.names, actuators, strict=True)
    ]
    return replace(room, rest=np.where(goal, room.rest, np.clip(0.0, room.low, room.high)))


def room(bench: Bench, logs: Sequence[Log], start: Log) -> Room:
    """From each actuator's `ctrlrange`, a firmware servo's joint range, or the commands that the logs hold.

    Raises:
      InputError: the mapping names no controls, or none of them has any room.
    """
    names = tuple(start.controls)
    if not names:
        raise InputError("the mapping names no `controls`: without a command there is no motion to propose")
    model, entries = bench.plant.model, bench.dataset.mapping.controls
    low, high, rest = np.zeros(len(names)), np.zeros(len(names)), np.zeros(len(names))
    for i, name in enumerate(names):
        a = actuator_names(model).index(name.removeprefix("ctrl:"))
        servo = entries[name].servo
        seen = np.concatenate([log.controls[name] for log in logs])
        low[i], high[i] = seen.min(), seen.max()
        joint = -1 if servo is None else mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, servo.joint)
        if servo is None and model.actuator_ctrllimited[a]:
            low[i], high[i] = model.actuator_ctrlrange[a]
        elif joint >= 0 and model.jnt_limited[joint]:
            low[i], high[i] = model.jnt_range[joint]
        rest[i] = np.clip(start.controls[name][0], low[i], high[i])
    if not (high - low > 1e-9 * np.maximum(np.abs(high), 1e-9)).any():
        raise InputError(
            f"{', '.join(names)}: the model gives no ctrlrange and the logs hold one command only, so that nothing is "
            "known of what may be commanded; give the actuators a ctrlrange in the model"
        )
    return Room(names, low, rest, high)
