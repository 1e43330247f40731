"""Joints that remember: a force that depends on where a joint came from, not on how fast.

The hidden state w lies in [-1, 1] and follows the joint's travel x by the normalised Bouc-Wen equation of Ikhouane and
Rodellar, Systems with Hysteresis (Wiley 2007), section 3.3,

    dw/dx = (1 - sigma sign(dx) |w|^(n-1) w + (sigma - 1) |w|^n) / transition,

which is what is left of Bouc-Wen's seven parameters once those that do the same are merged. Here n = 1 and sigma = 1,
which is Dahl's solid friction (Aerospace Corporation report TOR-0158(3107-18)-1, 1968): dw/dx = (1 - sign(dx) w) /
transition. It has an exact solution for a joint that moves one way through a step, which makes w as rate-independent in
a simulation as it is on paper. LuGre friction is this law with Stribeck's level and viscous damping beside it:
`hysteresis` with `stribeck` and `damping_poly` at the same joint.
"""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from typing import Any

import mujoco
import numpy as np

from nfc_gym.physics.effects.base import Array, Context, Effect, Forces, Scales
from nfc_gym.physics.effects.friction import level_size
from nfc_gym.physics.effects.lookup import index, joint_dofs
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

_STIFFEST = 0.25  # of M / dt^2, a joint's inertia over the squared step: stiffer springs no step can follow


def dahl(w: Array, travel: Array, transition: Array) -> Array:
    """Dahl's state w after a joint has gone on by `travel`, all (...,)."""
    side = np.sign(travel)
    return side + (w - side) * np.exp(-np.abs(travel) / transition)


class Hysteresis(Effect):
    """Force -level w: a spring of stiffness level / transition that yields at `level`, and remembers where it did.

    A step cannot resolve a spring stiffer than a quarter of M / dt^2, with M the joint's inertia: the transition is
    taken to be at least so long that this one is not exceeded.
    """

    family = "hysteresis"
    summary = "Hysteresis: a spring that yields"
    simpler = (("coulomb",), ("spring_offset",), ("coulomb", "spring_offset"))
    PARAMS = (
        Param("level", "N m", 0.0, 1e3, probes=(0.01, 0.1)),
        Param("transition", "rad", 1e-4, 10.0, probes=(0.02, 0.1, 0.3), shape=True),
    )

    def bind(self, model: mujoco.MjModel) -> None:
        dofs = joint_dofs(model, self.where)
        self.dofs, self.params = index(dofs), with_joint_units(self.params, model, dofs)

    def rest(self, ctx: Context, theta: Array) -> Any:
        return np.zeros_like(ctx.v[..., self.dofs])

    def follow(self, ctx: Context, theta: Array, memory: Any) -> Any:
        mobility = ctx.nominal("dof_invweight0")[..., self.dofs]
        shortest = theta[..., 0:1] * (mobility * ctx.dt**2 / _STIFFEST)
        return dahl(memory, ctx.v[..., self.dofs] * ctx.dt, np.maximum(theta[..., 1:2], shortest))

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        out.qfrc[..., self.dofs] -= theta[..., 0:1] * ctx.memory

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for where in joint_places(model):
            force, reach = joint_scales(model, scales, where)[0], excursion(model, scales, where[0])
            shape = {"probes": tuple(s * reach for s in (0.03, 0.2, 0.7)), "low": 1e-3 * reach, "high": 3 * reach}
            units = {"level": force_unit(model, where[0]), "transition": angle_unit(model, where[0])}
            level = level_size(force, largest_push(model, scales, where))
            out.append(cls(where, with_units(sized(cls.PARAMS, level=level, transition=shape), units)))
        return out


def excursion(model: mujoco.MjModel, scales: Scales, joint: str) -> float:
    """How far a joint typically moves to either side: as measured, else in a fifth of a second at its speed."""
    spread, _ = scales.channels.get(f"joint:{joint}:pos", (0.0, 0.0))
    speed = joint_scales(model, scales, (joint,))[1]
    return spread if spread > 1e-4 else 0.2 * speed
