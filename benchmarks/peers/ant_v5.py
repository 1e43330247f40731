"""Gymnasium's Ant-v5 on this package's engine: the same MJCF, frame skip, observation and reward, equal to 1e-9.

`AntV5` leaves out the contact forces (78 of 105 observed values, and a cost), which is an option of Ant-v5 itself;
`AntV5Contact` has them. Gymnasium calls `mj_rnePostConstraint` after `mj_step`, which finds the forces of the last
stage of the last physics step's Runge-Kutta scheme. A batch has no such call, but with a force sensor its `forward`
finds them; so the simulations go back to that stage for one evaluation more, the 21st of a control step.
"""

from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.envs.robot import Array, Ground, Robot, Start
from nfc_gym.envs.vector import RobotVectorEnv
from nfc_gym.envs.view import View

MJCF = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "ant.xml"
NOISE = 0.1  # of the start: uniform for positions, standard normal times this for velocities
HEALTHY = (0.2, 1.0)  # m, height of the torso
CTRL_COST, CONTACT_COST = 0.5, 5e-4
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]  # of a cross product


class Now(NamedTuple):
    x: Array  # (*B,) m, the torso's, as `MjData.xpos` has it


class AntV5(Robot):
    name = "ant_v5"
    tasks = ("run",)
    action_size, proprio_size, draws = 8, 27, 15 + 2 * 14
    frame_skip, precision = 5, np.float64
    reads = ("xpos",)
    terms = ("forward", "survive", "ctrl")

    def __init__(self, model: mujoco.MjModel, task: str) -> None:
        super().__init__(model, task)
        self.dt = model.opt.timestep * self.frame_skip

    @classmethod
    def parameters(cls) -> list:
        return []

    @classmethod
    def compile(cls, maps: int) -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_path(str(MJCF))

    def begin(self, u: Array, ground: Ground) -> Start:
        radius, angle = np.sqrt(-2 * np.log1p(-u[..., 15:29])), 2 * np.pi * u[..., 29:]
        return Start(self.home + NOISE * (2 * u[..., :15] - 1), qvel=NOISE * radius * np.cos(angle))

    def actuate(self, action: Array, view: View) -> Array:
        return action

    def derive(self, view: View) -> Now:
        return Now(view.xpos[..., 1, 0].copy())  # the array is live, and the next step compares with it

    def reward(self, view: View, action: Array) -> dict[str, Array]:
        return {
            "forward": (view.now.x - view.before.x) / self.dt,
            "survive": 1.0 * self.healthy(view),
            "ctrl": -CTRL_COST * (action * action).sum(-1),
        }

    @staticmethod
    def healthy(view: View) -> NDArray[np.bool_]:
        z = view.qpos[..., 2]
        return (z >= HEALTHY[0]) & (z <= HEALTHY[1])

    def terminated(self, view: View) -> NDArray[np.bool_]:
        return ~self.healthy(view)

    def proprio(self, view: View) -> tuple[NDArray, ...]:
        return view.qpos[..., 2:], view.qvel


class AntV5Contact(AntV5):
    proprio_size = 105
    reads = ("xpos", "cfrc_ext")
    terms = ("forward", "survive", "ctrl", "contact")

    @classmethod
    def compile(cls, maps: int) -> mujoco.MjModel:
        spec = mujoco.MjSpec.from_file(str(MJCF))
        torso = spec.body("torso")
        torso.add_site(name="torso_force")
        spec.add_sensor(
            name="torso_force",
            type=mujoco.mjtSensor.mjSENS_FORCE,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            objname="torso_force",
        )
        return spec.compile()

    def reward(self, view: View, action: Array) -> dict[str, Array]:
        forces = self.forces(view)
        return super().reward(view, action) | {"contact": -CONTACT_COST * (forces * forces).sum(-1)}

    @staticmethod
    def forces(view: View) -> Array:
        """(*B, 78) wrench on every body but the world, clipped."""
        cfrc = view.cfrc_ext[..., 1:, :]
        return np.clip(cfrc, -1, 1).reshape(*cfrc.shape[:-2], -1)

    def proprio(self, view: View) -> tuple[NDArray, ...]:
        return *super().proprio(view), self.forces(view)


class AntV5ContactVectorEnv(RobotVectorEnv):
    """The vector engine, with one more evaluation a control step for the contact forces."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(AntV5Contact, context=(), **kwargs)
        names = ("xpos", "xquat", "xmat", "cvel", "subtree_com", "actuator_length", "actuator_velocity")
        self._stage = {name: self.batch.bind(name) for name in names}
        self._gear = self.model.actuator_gear[:, 0].copy()
        self._hinges = self.model.actuator_trnid[:, 0] - 1  # actuators in the order of the file, not of the joints
        # The sensor is looked at in the last evaluation alone: the others need no contact forces.
        self._flags = self.batch.expand("opt.disableflags")
        self._on = int(self.model.opt.disableflags)
        self._off = self._on | int(mujoco.mjtDisableBit.mjDSBL_SENSOR)

    def _run(self, active: NDArray[np.bool_] | None) -> None:
        batch = self.batch
        self._flags[...] = self._off
        batch.step(active, nstep=self.frame_skip - 1)
        warm = batch.qacc_warmstart.copy()
        batch.step(active)
        end = batch.state.copy()
        self._to_last_stage()
        batch.qacc_warmstart[...] = warm
        self._flags[...] = self._on
        batch.forward(active)
        batch.state[...] = end

    def _to_last_stage(self) -> None:
        """The state at which derived fields were computed last, found from those fields."""
        stage, qpos, qvel = self._stage, self.batch.qpos, self.batch.qvel
        qpos[:, :3], qpos[:, 3:7] = stage["xpos"][:, 1], stage["xquat"][:, 1]
        qpos[:, 7 + self._hinges] = stage["actuator_length"] / self._gear
        spin, speed = stage["cvel"][:, 1, :3], stage["cvel"][:, 1, 3:]  # of the point at the centre of mass
        arm = stage["subtree_com"][:, 1] - stage["xpos"][:, 1]
        qvel[:, :3] = speed - (spin[:, _NEXT] * arm[:, _LAST] - spin[:, _LAST] * arm[:, _NEXT])
        qvel[:, 3:6] = (spin[:, None] @ stage["xmat"][:, 1].reshape(-1, 3, 3))[:, 0]
        qvel[:, 6 + self._hinges] = stage["actuator_velocity"] / self._gear
