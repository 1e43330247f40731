"""Where a replay starts: the model's state from what a robot observes of itself, and how far off that may be."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.envs.jackal import FULL_SPEED, FULL_TURN, Jackal
from nfc_gym.envs.quadcopter import Quadcopter
from nfc_gym.envs.rotations import axes, to_world
from nfc_gym.simulate.machine import Machine

Array = NDArray[np.float64]
# Measurement noise of quantities that `proprio` does not have, of the sizes of `machine.HABITS`.
_NOISE = {
    "body:pos": 0.02, "body:quat": 0.0025, "body:linvel": 0.05, "body:angvel": 0.03, "joint:pos": 0.002,
    "joint:vel": 0.05,
}  # fmt: skip
# What no sensor tells: a Jackal's wheels lag behind their command and slip, a Quadcopter's mounts sway. So much of the
# wheels' speed is what they were told, the rest is how the robot moves; and so far off are both then, in rad/s, over
# 1500 windows of `trials` (standard deviations).
_TOLD = 0.68
_HIDDEN = {"jackal": 1.75, "quadcopter": 0.15}


def observed(machine: Machine, states: Array) -> Array:
    """(n, nq + nv) from observations `proprio` (n, s).

    The Jackal's wheels are taken to turn between how they were last told to and how the robot moves, the Quadcopter's
    mounts to be at rest; `disturbed(..., hidden=True)` knows how far that is off.

    Raises:
      InputError: `proprio` does not determine the state of this robot.
    """
    model, kind = machine.model, machine.kind
    qpos, qvel = np.tile(machine.settings.robot(model).home, (len(states), 1)), np.zeros((len(states), model.nv))
    if issubclass(kind, Jackal):
        qpos[:, 3:7], qpos[:, :3] = states[:, :4], states[:, 10:13]
        qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
        qvel[:, :3] = to_world(axes(qpos[:, 3:7]), states[:, 4:7])
        qvel[:, 3:6] = states[:, 7:10]
        moves = states[:, [4, 9]] / (FULL_SPEED, FULL_TURN)  # the command that would have it move so
        wheels = machine.settings.robot(model).actuate(_TOLD * states[:, 13:15] + (1 - _TOLD) * moves, None)  # type: ignore[arg-type]
        qvel[:, model.jnt_dofadr[model.actuator_trnid[:, 0]]] = wheels
    elif issubclass(kind, Quadcopter):
        qpos[:, 3:7] = states[:, 3:7] / np.linalg.norm(states[:, 3:7], axis=1, keepdims=True)
        qpos[:, 7:], qvel[:, :6] = states[:, 13:], states[:, 7:13]
    else:
        raise InputError(
            f"replay: what a {kind.name} observes does not determine its state (where its base is, or how it leans); "
            "give `start`, positions and velocities by a state estimate. Without one: jackal, quadcopter"
        )
    return np.concatenate([qpos, qvel], 1)


def spreads(machine: Machine, hidden: bool = False) -> tuple[Array, Array]:
    """(nv,) standard deviations of a measured start, in the model's tangent space: of positions and of velocities.

    Args:
      machine: whose.
      hidden: the start is `observed`, and what no sensor tells is a guess.
    """
    own: dict[str, float] = {}
    for name, sd in zip(machine.state_names, machine.noise, strict=True):
        parts = name.split(":")
        if len(parts) == 3:
            own.setdefault(f"{parts[0]}:{parts[2].split('.')[0].split('@')[0]}", float(sd))
    if hidden and machine.kind.name in _HIDDEN:
        own["joint:vel"] = _HIDDEN[machine.kind.name]
    noise, model = _NOISE | own, machine.model
    position, velocity = np.full(model.nv, noise["joint:pos"]), np.full(model.nv, noise["joint:vel"])
    if model.jnt_type[0] == int(mujoco.mjtJoint.mjJNT_FREE):
        position[:3], position[3:6] = noise["body:pos"], 2 * noise["body:quat"]  # an angle is twice a quaternion's part
        velocity[:3], velocity[3:6] = noise["body:linvel"], noise["body:angvel"]
    return position, velocity


def disturbed(machine: Machine, start: Array, eps: Array, hidden: bool = False) -> Array:
    """Starts (n, nq + nv) with noise: eps (n, 2 nv), standard normal; `hidden` as in `spreads`."""
    model = machine.model
    position, velocity = spreads(machine, hidden)
    qpos, qvel = start[:, : model.nq].copy(), start[:, model.nq :] + eps[:, model.nv :] * velocity
    for row, moved in zip(qpos, eps[:, : model.nv] * position, strict=True):
        mujoco.mj_integratePos(model, row, moved, 1.0)
    if hidden and issubclass(machine.kind, Jackal) and not machine.rough:
        qpos[:, 2] = _standing(machine, qpos[:, 3:7])
    return np.concatenate([qpos, qvel], 1)


def _standing(machine: Machine, quat: Array) -> Array:
    """(n,) m, heights at which the lowest wheel stands on the plane.

    Heights are measured to 2 cm; dropped from as much, or pushed out of the ground, a replay bounces for half a second.
    """
    model = machine.model
    wheels = model.body_pos[model.jnt_bodyid[model.actuator_trnid[:, 0]]]
    above = np.stack([to_world(axes(quat), np.broadcast_to(w, (len(quat), 3)))[:, 2] for w in wheels])
    return machine.settings.robot(model).home[2] + wheels[:, 2].min() - above.min(0)
