"""Air: drag of a body, wind, and what a rotor feels when it is carried through the air.

The motion of a body is that of its centre of mass: from the current state where the body has a free joint, else from
MuJoCo's derived fields, which are one substep behind.
"""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.physics.effects.base import Array, Context, Effect, Forces, Param, Scales
from nfc_gym.physics.effects.places import base_bodies, body_ids, sized
from nfc_gym.physics.state import cross, rotate, rotate_back

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)


def body_motion(ctx: Context, body: int) -> tuple[Array, Array]:
    """Orientation quaternion (..., 4) and velocity of the centre of mass in the world (..., 3), m/s."""
    model = ctx.model
    joint = int(model.body_jntadr[body])
    if joint >= 0 and int(model.jnt_type[joint]) == _FREE:
        q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        quat = ctx.q[..., q + 3 : q + 7]
        arm = cross(ctx.v[..., v + 3 : v + 6], ctx.nominal("body_ipos")[..., body, :])
        return quat, ctx.v[..., v : v + 3] + rotate(quat, arm)
    spatial = ctx.data("cvel")[..., body, :]
    arm = ctx.data("xipos")[..., body, :] - ctx.data("subtree_com")[..., int(model.body_rootid[body]), :]
    return ctx.data("xquat")[..., body, :], spatial[..., 3:] + cross(spatial[..., :3], arm)


def translating(model: mujoco.MjModel) -> list[str]:
    """Bodies that air can act on with effect: bases that move through the world."""
    return base_bodies(model)


def body_scales(model: mujoco.MjModel, scales: Scales, body: int) -> tuple[float, float]:
    """(force in N, speed in m/s) typical of a base: weight and measured force, and the speed of its translations."""
    dofs: list[int] = []
    b = body
    while b > 0:
        for j in range(int(model.body_jntadr[b]), int(model.body_jntadr[b]) + int(model.body_jntnum[b])):
            kind, at = int(model.jnt_type[j]), int(model.jnt_dofadr[j])
            if kind == _FREE:
                dofs += [at, at + 1, at + 2]
            elif kind == int(mujoco.mjtJoint.mjJNT_SLIDE):
                dofs.append(at)
        b = int(model.body_parentid[b])
    speed = max(float(np.linalg.norm(scales.speed[dofs])) if dofs else 0.0, 0.05)
    weight = float(model.body_subtreemass[body] * np.linalg.norm(model.opt.gravity))
    force = float(np.median(np.abs(scales.force[dofs]))) if dofs else 0.0
    return max(force, 0.1 * weight, 1e-3), speed


class _BodyForce(Effect):
    """What forces on bodies share."""

    def bind(self, model: mujoco.MjModel) -> None:
        self.bodies: NDArray[np.intp] = body_ids(model, self.where)


class DragLinear(_BodyForce):
    """Drag proportional to speed along each of the body's axes: F = -(x vx, y vy, z vz), at the centre of mass."""

    family = "drag_linear"
    summary = "Linear air drag along the body's axes"
    PARAMS = tuple(Param(axis, "N s/m", 0.0, 1e3, probes=(0.1,)) for axis in "xyz")
    power = 1

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        for b in self.bodies:
            quat, velocity = body_motion(ctx, int(b))
            along = rotate_back(quat, velocity)
            if self.power == 2:
                along = along * np.linalg.norm(along, axis=-1, keepdims=True)
            out.xfrc[..., b, :3] += rotate(quat, -theta * along)

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        names = translating(model)
        for name, b in zip(names, body_ids(model, names), strict=True):
            force, speed = body_scales(model, scales, int(b))
            unit = force / speed**cls.power
            size = {"probes": (0.1 * unit,), "high": 5 * unit, "resolution": 2e-3 * unit}
            out.append(cls((name,), sized(cls.PARAMS, x=size, y=size, z=size)))
        return out


class DragQuadratic(DragLinear):
    """Drag proportional to speed squared: F = -|v| (x vx, y vy, z vz) in the body's axes, at the centre of mass."""

    family = "drag_quadratic"
    summary = "Quadratic air drag along the body's axes"
    PARAMS = tuple(Param(axis, "N s^2/m^2", 0.0, 1e3, probes=(0.1,)) for axis in "xyz")
    power = 2
