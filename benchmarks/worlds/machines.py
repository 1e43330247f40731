"""A robot's class whose model is a hidden truth, while all that it tells of psi is nominal."""

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from nfc_gym import assets
from nfc_gym.envs import scene
from nfc_gym.envs.ant import Ant
from nfc_gym.envs.humanoid import Humanoid
from nfc_gym.envs.jackal import Jackal
from nfc_gym.envs.quadcopter import Quadcopter
from nfc_gym.envs.quadruped import Quadruped
from nfc_gym.envs.robot import Robot
from nfc_gym.measured.hidden import Array
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.parameters import ParameterSpace

from .truth import Truth

ROBOTS: dict[str, type[Robot]] = {k.name: k for k in (Ant, Quadruped, Humanoid, Quadcopter, Jackal)}


class Believed(ParameterSpace):
    """psi as the agent's model has it. What is written through it reaches the observation, never the machine."""

    def write(self, fields: ModelFields, values: Any) -> None:
        """Nothing: the truth is in the model already."""


def nominal_space(kind: type[Robot]) -> ParameterSpace:
    """psi of the robot as its MJCF has it."""
    return kind.space(kind.compile(0))


def machine(kind: type[Robot], truth: Truth) -> type[Robot]:
    """The robot with a truth of its own.

    Args:
      kind: a robot of the package: its laws of observation, reward and termination are kept.
      truth: what its model is.
    """
    nominal = kind.compile(0)
    space = kind.space(nominal)

    def compile_true(cls: type[Robot], maps: int) -> mujoco.MjModel:
        return scene.build(assets.path(kind.name), maps, lambda spec: truth.shape(spec, space))

    def believed(cls: type[Robot], model: mujoco.MjModel) -> ParameterSpace:
        return Believed(nominal, kind.parameters())

    changed: dict[str, Any] = {"compile": classmethod(compile_true), "space": classmethod(believed)}
    return type(f"Hidden{kind.__name__}", (kind,), {"__doc__": kind.__doc__, **changed})


# Standard deviations of what a robot's estimator and encoders report, by the quantity that a component's name ends in.
SENSORS: Mapping[str, float] = {
    "quat": 0.003,  # 0.3 degrees of roll, pitch and heading
    "linvel": 0.03,  # m/s
    "angvel": 0.02,  # rad/s, a gyro's with its bias gone
    "pos": 0.005,  # m, and rad of a joint
    "vel": 0.1,  # rad/s of a joint, a difference of encoder counts
}


def sensor_noise(components: list[str]) -> Array:
    """(k,) standard deviation of each entry of `proprio`, 0 where no sensor stands behind it."""
    kinds = [c.split(":")[-1].split(".")[0].removesuffix("@body") for c in components]
    return np.array([SENSORS.get(k, 0.0) for k in kinds])
