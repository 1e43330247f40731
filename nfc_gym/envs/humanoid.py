"""Humanoid: sixteen bodies and twenty-one joints, each with a motor; it runs towards a target."""

import mujoco
from numpy.typing import NDArray

from nfc_gym.envs.components import joints, observed, torso
from nfc_gym.envs.mirror import Plane, Signed
from nfc_gym.envs.runner import Runner, Weights
from nfc_gym.envs.view import View


class Humanoid(Runner):
    """Twenty-one actions: joint torques in units of the largest, 22.5 N m (ankles) to 135 N m (hips)."""

    name = "humanoid"
    action_size, proprio_size, draws = 21, 108, 4 + 21
    reads = ("sensordata", "qfrc_actuator")
    lowest = 0.8  # m: it stands at 1.27 m; kneeling is lower than that
    noise = 0.02  # rad: upright balance leaves no room for more
    feet = ("right_foot", "left_foot")
    weights = Weights(
        progress=1.0,  # the unit of all others: 1 for each m/s
        alive=1.0,  # standing is worth a walk of 1 m/s; at twice that PPO learns to stand, and stays with it
        upright=0.1,  # just enough to choose an upright torso between gaits that are as fast
        heading=0.5,  # running sideways must be 0.5 m/s faster to pay
        action=0.01,  # full torque everywhere costs 0.21
        energy=0.0002,  # 1 kW, about what it takes to run, costs 0.2
        limits=0.25,  # both knees stretched to the stop cost 0.5: it is to walk on bent ones
    )

    def components(self, model: mujoco.MjModel) -> list[str]:
        """See `Robot`."""
        return [*torso(model), *joints(model, "pos"), *joints(model, "vel"), *observed(21 + 12 + 21)]

    def reflected(self, model: mujoco.MjModel, plane: Plane) -> tuple[list[Signed], Signed]:
        """See `Robot`."""
        motors = self.motors_reflected(model, plane)
        return [self.torso_reflected(plane), motors, self.feet_reflected(model, plane), motors], motors

    def proprio(self, view: View) -> tuple[NDArray, ...]:
        """Torso 12, joint positions, velocities, torques 21 each (rad, rad/s, N m), feet 12 (N, N m), action 21."""
        return (
            self.torso(view),
            view.qpos[..., 7:],
            view.qvel[..., 6:],
            view.field("qfrc_actuator")[..., 6:],
            view.sensordata[..., self.wrenches],
            view.task["action"],
        )
