"""Ant: four legs of two joints each, eight motors; it runs towards a target."""

import mujoco
from numpy.typing import NDArray

from nfc_gym.envs.components import joints, observed, torso
from nfc_gym.envs.mirror import ENDS, SIDES, Plane, Signed
from nfc_gym.envs.runner import Runner, Weights
from nfc_gym.envs.view import View


class Ant(Runner):
    """Eight actions: torque of hip and ankle of each leg, in units of the largest, 30 N m."""

    name = "ant"
    planes = (SIDES, ENDS)
    action_size, proprio_size, draws = 8, 52, 4 + 8
    reads = ("sensordata",)
    lowest = 0.26  # m: the torso, of 0.25 m radius, all but touches the ground
    noise = 0.05  # rad
    feet = ("front_left_foot", "front_right_foot", "rear_left_foot", "rear_right_foot")
    weights = Weights(
        progress=1.0,  # the unit of all others: 1 for each m/s
        alive=0.5,  # standing still is worth a walk of 0.5 m/s, so that falling never pays
        upright=0.1,  # just enough to choose a level torso between gaits that are as fast
        heading=0.5,  # running sideways must be 0.5 m/s faster to pay
        action=0.005,  # full torque everywhere costs 0.04
        energy=0.0005,  # 240 W, about what it takes to run, costs 0.12
        limits=0.05,  # resting on all four ankles' stops costs 0.2
    )

    def components(self, model: mujoco.MjModel) -> list[str]:
        """See `Robot`."""
        return [*torso(model), *joints(model, "pos"), *joints(model, "vel"), *observed(24)]

    def reflected(self, model: mujoco.MjModel, plane: Plane) -> tuple[list[Signed], Signed]:
        """See `Robot`."""
        return [self.torso_reflected(plane), self.feet_reflected(model, plane)], self.motors_reflected(model, plane)

    def proprio(self, view: View) -> tuple[NDArray, ...]:
        """Torso 12, joint positions 8 (rad), joint velocities 8 (rad/s), force and torque of each foot 24 (N, N m)."""
        return self.torso(view), view.qpos[..., 7:], view.qvel[..., 6:], view.sensordata[..., self.wrenches]
