"""Dry friction of joints. All four laws set the level that MuJoCo's constraint solver may use to hold or brake a joint.

MuJoCo's default friction is soft (a time constant of 20 ms): a joint creeps under a load that real friction holds.
Where the nominal model has no friction of its own the effects therefore make it sharp, with the shortest time constant
that a step allows (2 dt) and an impedance of 0.99, which leaves a creep speed of about one per cent of what the load
would add in a step. A joint whose friction the user already declared keeps the user's softness.
"""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.physics.effects.base import Array, Context, Effect, Scales
from nfc_gym.physics.effects.lookup import Rows, index, joint_dofs
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import (
    angle_unit,
    force_unit,
    joint_places,
    joint_scales,
    largest_push,
    sized,
    with_joint_units,
    with_units,
)
from nfc_gym.physics.fields import ModelFields

_IMPEDANCE = (0.99, 0.99, 0.001, 0.5, 2.0)
_TURN = 0.01  # rad/s or m/s: speed over which a direction-dependent level passes from one side to the other


def sharpen(fields: ModelFields, dofs: NDArray[np.intp]) -> None:
    """Make dry friction sharp on those dofs where the nominal model has none (its softness then acts on nothing)."""
    bare = dofs[fields.nominal("dof_frictionloss")[dofs] == 0]
    if len(bare):
        fields["dof_solref"][..., bare, :] = (2 * float(fields.nominal_model.opt.timestep), 1.0)
        fields["dof_solimp"][..., bare, :] = _IMPEDANCE


class _JointFriction(Effect):
    """What the laws share: joints, a sharp constraint, a level in N m or N."""

    LEVELS = ("level",)

    def bind(self, model: mujoco.MjModel) -> None:
        self.dofs = joint_dofs(model, self.where, self.BALLS)
        self.at, self.params = index(self.dofs), with_joint_units(self.params, model, self.dofs)

    def model(self, fields: ModelFields, theta: Array) -> None:
        sharpen(fields, self.dofs)

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for where in joint_places(model):
            force, speed = joint_scales(model, scales, where)
            unit = force_unit(model, where[0])
            params = sized(cls.PARAMS, **cls._sizes(force, speed, largest_push(model, scales, where)))
            angle = angle_unit(model, where[0])
            units = dict.fromkeys(cls.LEVELS, unit) | {"speed": f"{angle}/s", "square": f"1/({unit})"}
            units |= dict.fromkeys(("forward_viscous", "backward_viscous"), f"{unit} s/{angle}")
            out.append(cls(where, with_units(params, units)))
        return out

    @classmethod
    def _sizes(cls, force: float, speed: float, push: float) -> dict[str, dict[str, Any]]:
        return {n: level_size(force, push) for n in cls.LEVELS}


def level_size(force: float, push: float = 0.0) -> dict[str, Any]:
    """Bounds and probing sizes of a friction level.

    Args:
      force: typical of the joint.
      push: largest that is known to have moved it, 0 if none is.
    """
    # A joint that moves at all has less friction than what pushes it. The largest push is about thrice the typical; a
    # model without friction needs less force than the machine, whose own push is then the better bound.
    return {"probes": (0.05 * force, 0.2 * force), "high": max(3 * force, push), "resolution": 2e-3 * force}


class Coulomb(_JointFriction):
    """Constant friction: |force| <= level, opposing motion."""

    family = "coulomb"
    BALLS = True
    summary = "Dry (Coulomb) friction"
    PARAMS = (Param("level", "N m", 0.0, 1e3, probes=(0.01, 0.1)),)

    def model(self, fields: ModelFields, theta: Array) -> None:
        super().model(fields, theta)
        fields["dof_frictionloss"][..., self.dofs] += theta[..., :1]

    def spec(self, spec: mujoco.MjSpec, theta: Array) -> bool:
        for name in self.where:
            joint = spec.joint(name)
            if joint.frictionloss == 0:
                joint.solref_friction = (2 * spec.option.timestep, 1.0)
                joint.solimp_friction = _IMPEDANCE
            joint.frictionloss += float(theta[0])
        return True


class Stribeck(_JointFriction):
    """Friction that is higher at rest: level + rise exp(-(v / speed)^2).

    Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30 (1994).
    """

    family = "stribeck"
    summary = "Dry friction with a Stribeck rise at low speed"
    simpler = (("coulomb",), ("coulomb", "damping_poly"))
    LEVELS = ("level", "rise")
    PARAMS = (
        Param("level", "N m", 0.0, 1e3, probes=(0.01, 0.1)),
        Param("rise", "N m", 0.0, 1e3, probes=(0.01, 0.1)),
        Param("speed", "rad/s", 1e-3, 1e2, probes=(0.1, 0.3, 1.0), shape=True),
    )

    def friction(self, ctx: Context, theta: Array) -> tuple[Rows, Array]:
        level, rise, speed = theta[..., 0:1], theta[..., 1:2], theta[..., 2:3]
        share = ctx.v[..., self.at] / speed
        return self.at, level + rise * np.exp(-share * share)

    @classmethod
    def _sizes(cls, force: float, speed: float, push: float) -> dict[str, dict[str, Any]]:
        shape = {"probes": (0.1 * speed, 0.3 * speed, speed), "low": 0.01 * speed, "high": 5 * speed}
        return super()._sizes(force, speed, push) | {"speed": shape}


class LoadFriction(_JointFriction):
    """Friction of a loaded gear: level + |motor * drive + external * bias| + square * drive^2, all of them torques.

    The actuator pushes the gear's one side (`qfrc_actuator`); gravity, Coriolis and centrifugal forces push the other
    (`qfrc_bias`, the torque that must be applied to balance them). A joint held still has both equal, and they add up.
    With `motor` alone the gear is loaded by its own drive only; `square` is what a gear loses near its limit. Contact
    forces are not counted: MuJoCo does not tell them apart from the friction itself. Law: load-dependent models of
    Duclusaud et al., arXiv:2410.08650 (2024).
    """

    family = "load_friction"
    summary = "Gear friction that grows with the load"
    simpler = (("coulomb",), ("coulomb", "damping_poly"))
    PARAMS = (
        Param("level", "N m", 0.0, 1e3, probes=(0.01, 0.1)),
        Param("motor", "1", 0.0, 0.8, probes=(0.05, 0.2), resolution=2e-3),
        Param("external", "1", 0.0, 0.8, probes=(0.05, 0.2), resolution=2e-3),
        Param("square", "1/(N m)", 0.0, 1e3, probes=(0.05, 0.2)),
    )

    def friction(self, ctx: Context, theta: Array) -> tuple[Rows, Array]:
        torque = ctx.data("qfrc_actuator")[..., self.at]
        drive = theta[..., 1:2] * torque
        load = theta[..., 2:3] * ctx.data("qfrc_bias")[..., self.at]
        return self.at, theta[..., 0:1] + np.abs(drive + load) + theta[..., 3:4] * torque**2

    @classmethod
    def _sizes(cls, force: float, speed: float, push: float) -> dict[str, dict[str, Any]]:
        square = {"probes": (0.05 / force, 0.2 / force), "high": 1 / force, "resolution": 2e-3 / force}
        return super()._sizes(force, speed, push) | {"square": square}


class DirectionalFriction(_JointFriction):
    """Friction with a law for each direction of motion, level + viscous |v|; they meet within 0.01 rad/s (m/s) of rest.

    Preloaded screws and gears do so in both parts: Janot, Gautier and Brunot (2019) report it of such a drive.
    """

    family = "directional_friction"
    summary = "Dry friction that differs by direction of motion"
    simpler = (("coulomb",), ("damping_poly",), ("coulomb", "damping_poly"), ("coulomb", "external_force"))
    LEVELS = ("forward", "backward")
    PARAMS = (
        Param("forward", "N m", 0.0, 1e3, probes=(0.01, 0.1)),
        Param("backward", "N m", 0.0, 1e3, probes=(0.01, 0.1)),
        Param("forward_viscous", "N m s/rad", 0.0, 1e5, probes=(0.01, 0.1)),
        Param("backward_viscous", "N m s/rad", 0.0, 1e5, probes=(0.01, 0.1)),
    )

    def friction(self, ctx: Context, theta: Array) -> tuple[Rows, Array]:
        v = ctx.v[..., self.at]
        ahead, speed = (1 + np.tanh(v / _TURN)) / 2, np.abs(v)
        forward = theta[..., 0:1] + theta[..., 2:3] * speed
        backward = theta[..., 1:2] + theta[..., 3:4] * speed
        return self.at, forward * ahead + backward * (1 - ahead)

    @classmethod
    def _sizes(cls, force: float, speed: float, push: float) -> dict[str, dict[str, Any]]:
        viscous = level_size(force / speed, push / speed)
        return super()._sizes(force, speed, push) | {"forward_viscous": viscous, "backward_viscous": viscous}
