"""What a robot's state estimator says: positions and speeds of the model that the agent knows, with sensors' noise."""

from typing import Any, NamedTuple

import mujoco
import numpy as np

from nfc_gym.measured.hidden import Array

from .judge import whole_state
from .machines import SENSORS

FREE = int(mujoco.mjtJoint.mjJNT_FREE)


class Estimate(NamedTuple):
    """In the order of the nominal model: what a world adds to the machine is not sensed.

    Attributes:
      qpos, qvel: (nq,) and (nv,).
      act: (na,) states of the actuators; in the second engine the last commands stand for them.
    """

    qpos: Array
    qvel: Array
    act: Array


def estimated(env: Any, nominal: mujoco.MjModel, noisy: bool, rng: np.random.Generator) -> Estimate:
    """Of a vector environment's first simulation.

    Args:
      env: what its machine has beyond the nominal one comes after the rest.
      nominal: the model that the agent knows.
      noisy: whether sensors are.
      rng: of their noise.
    """
    base = env.unwrapped
    every, speeds = whole_state(base)
    qpos, qvel = every[0, : nominal.nq], speeds[0, : nominal.nv]
    act = (base.batch.bind("act") if hasattr(base, "batch") else base.commands)[0, : nominal.na].copy()
    if not noisy:
        return Estimate(qpos, qvel, act)
    free = int(nominal.jnt_type[0]) == FREE
    sd = np.full(nominal.nv, SENSORS["pos"])
    rates = np.full(nominal.nv, SENSORS["vel"])
    if free:
        sd[3:6], rates[:3], rates[3:6] = SENSORS["quat"], SENSORS["linvel"], SENSORS["angvel"]
    mujoco.mj_integratePos(nominal, qpos, sd * rng.standard_normal(nominal.nv), 1.0)
    return Estimate(qpos, qvel + rates * rng.standard_normal(nominal.nv), act)
