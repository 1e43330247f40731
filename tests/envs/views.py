"""Views of states written by hand, so that a robot's laws are tested without an engine."""

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym import assets
from nfc_gym.envs.robot import Robot
from nfc_gym.envs.view import View


def robot_of(kind: type[Robot]) -> tuple[Robot, mujoco.MjModel]:
    """A robot with its first task, and its model on a plane."""
    model = mujoco.MjModel.from_xml_path(str(assets.path(kind.name)))
    return kind(model, kind.tasks[0]), model


def level(height: float) -> Any:
    """Ground at one height everywhere."""
    return lambda xy: np.full(xy.shape[:-1], height)[()]


def view_of(
    robot: Robot, model: mujoco.MjModel, fields: Mapping[str, NDArray], task: Mapping[str, NDArray], ground: Any = None
) -> View:
    """A view of given fields and task memory, with `now` derived; `before` is left to the caller."""
    view = View(model, lambda name: fields[name], robot.reads, ground or level(0.0))
    view.task = dict(task)
    view.now = robot.derive(view)
    return view


def blank(model: mujoco.MjModel) -> dict[str, NDArray]:
    """All fields that a walker reads, zero, at the keyframe `home`."""
    sizes = {"ctrl": model.nu, "sensordata": model.nsensordata, "qfrc_actuator": model.nv, "actuator_force": model.nu}
    fields = {name: np.zeros(size) for name, size in sizes.items()}
    return fields | {"qpos": model.key("home").qpos.copy(), "qvel": np.zeros(model.nv)}


def random_fields(model: mujoco.MjModel, rng: np.random.Generator, shape: tuple[int, ...]) -> dict[str, NDArray]:
    """Any state at all."""
    fields = {name: rng.normal(size=(*shape, len(value))) for name, value in blank(model).items()}
    fields["qpos"][..., 3:7] /= np.linalg.norm(fields["qpos"][..., 3:7], axis=-1, keepdims=True)
    return fields


def yawed(fields: Mapping[str, NDArray], angle: float, shift: Sequence[float]) -> dict[str, NDArray]:
    """The same states turned about the world's z axis by an angle and then shifted in the plane."""
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]])
    q, v = fields["qpos"].copy(), fields["qvel"].copy()
    q[..., :2] = q[..., :2] @ turn.T + shift
    v[..., :2] = v[..., :2] @ turn.T
    quat = fields["qpos"][..., 3:7]
    for i in np.ndindex(quat.shape[:-1]):
        mujoco.mju_mulQuat(q[i][3:7], np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)]), quat[i])
    return {**fields, "qpos": q, "qvel": v}


def proprio(robot: Robot, view: View) -> NDArray:
    """The observation as the engines put it together, in float64."""
    return np.concatenate(robot.proprio(view), -1)
