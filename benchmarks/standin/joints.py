"""Joints that a stand-in may hide: friction that differs by direction, and friction that remembers, by own formulas."""

import mujoco
import numpy as np

from nfc_gym.measured.hidden import Hidden

from .faults import OnJoint


class DirectionalFriction(OnJoint):
    """Dry friction and drag of one level forwards and another backwards: (level, N m s/rad) each.

    MuJoCo's constraint makes it, with a level that is set anew each step (see `Stribeck`).
    """

    family = "directional_friction"

    def __init__(self, joint: str, forward: tuple[float, float], backward: tuple[float, float]) -> None:
        values = {"forward": forward[0], "backward": backward[0]}
        values |= {"forward_viscous": forward[1], "backward_viscous": backward[1]}
        text = f"{joint} drags with {forward[0]:.3g} N m + {forward[1]:.3g} N m s/rad forwards"
        super().__init__((joint,), values, f"{text}, {backward[0]:.3g} N m + {backward[1]:.3g} N m s/rad backwards")

    def begin(self, model: mujoco.MjModel) -> None:
        super().begin(model)
        self.model = model
        model.dof_solref[self.v] = (2 * model.opt.timestep, 1.0)

    def push(self, data: mujoco.MjData) -> None:
        way = "forward" if data.qvel[self.v[0]] > 0 else "backward"
        level, viscous = self.parameters[way], self.parameters[f"{way}_viscous"]
        self.model.dof_frictionloss[self.v] = level + viscous * np.abs(data.qvel[self.v])


class SolidFriction(Hidden):
    """Dahl's solid friction: force -level w, where dw/dt = (v - |v| w) / transition.

    P. R. Dahl, A solid friction model, Aerospace Corporation TOR-0158(3107-18)-1 (1968), with exponent 1.
    """

    family = "hysteresis"

    def __init__(self, joint: str, level: float, transition: float) -> None:
        values = {"level": level, "transition": transition}
        super().__init__((joint,), values, f"{joint} has a spring that yields at {level:.3g} N m, {transition:.2g} rad")

    def begin(self, model: mujoco.MjModel) -> None:
        self.dof, self.step, self.w = int(model.joint(self.where[0]).dofadr[0]), model.opt.timestep, 0.0

    def push(self, data: mujoco.MjData) -> None:
        v: float = data.qvel[self.dof]
        self.w += self.step * (v - abs(v) * self.w) / self.parameters["transition"]
        data.qfrc_applied[self.dof] -= self.parameters["level"] * self.w
