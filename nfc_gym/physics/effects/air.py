"""Air: drag of a body, wind, and what a rotor feels when it is carried through the air.

Air acts on a body where the model has its centre of mass. A lump that rides on it, or a centre of mass that lies
elsewhere, does not move its hull: the force then turns the body as well. Its motion there comes from the current state
where the body has a free joint, else from MuJoCo's derived fields, which are one substep behind.
"""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from nfc_gym.physics.effects.base import Array, Context, Effect, Forces, Scales
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import base_bodies, body_ids, exposed_bodies, sized
from nfc_gym.physics.state import components, cross_parts, joined, root, rotate_back_parts, rotate_parts

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)


Parts = Sequence[Any]  # components (...) of a vector


def hull_mark(name: str) -> str:
    """Name of the numbers (3,) by which a model whose centre of mass was moved says where the body's hull is."""
    return f"hull:{name}"


def hull(model: mujoco.MjModel, body: int) -> Array:
    """(3,) place in the body's frame where air acts on it."""
    mark = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, hull_mark(model.body(body).name))
    at = int(model.numeric_adr[mark]) if mark >= 0 else 0
    return np.array(model.numeric_data[at : at + 3] if mark >= 0 else model.body_ipos[body])


class BodyMotion:
    """How a body's hull moves, and what pushes it there.

    Args:
      model: the nominal model.
      body: id of the body.
    """

    def __init__(self, model: mujoco.MjModel, body: int) -> None:
        self.body, self.root, self.hull = body, int(model.body_rootid[body]), hull(model, body)
        self._at = self.hull.tolist()
        joint = int(model.body_jntadr[body])
        self.free = joint >= 0 and int(model.jnt_type[joint]) == _FREE
        if self.free:
            q, v = int(model.jnt_qposadr[joint]) + 3, int(model.jnt_dofadr[joint])
            self.turn, self.rates = slice(q, q + 4), slice(v, v + 6)

    def quat(self, ctx: Context) -> Parts:
        """Orientation quaternion."""
        return components(ctx.q[..., self.turn] if self.free else ctx.data("xquat")[..., self.body, :])

    def velocity(self, ctx: Context, quat: Parts) -> Parts:
        """Velocity in the world, m/s; `quat` is the body's orientation."""
        if not self.free:
            return self._derived(ctx)
        linear, spun = self._of_joint(ctx)
        return _total(linear, rotate_parts(quat, spun))

    def own_velocity(self, ctx: Context, quat: Parts) -> Parts:
        """The same along the body's axes, m/s."""
        if not self.free:
            return rotate_back_parts(quat, self._derived(ctx))
        linear, spun = self._of_joint(ctx)
        return _total(rotate_back_parts(quat, linear), spun)

    def _of_joint(self, ctx: Context) -> tuple[Parts, Parts]:
        """The joint's velocity in the world, and what turning about it adds, along the body's axes."""
        x, y, z, *turning = components(ctx.v[..., self.rates])
        return (x, y, z), cross_parts(turning, self._at)

    def _derived(self, ctx: Context) -> Parts:
        spatial = ctx.data("cvel")[..., self.body, :]
        arm = ctx.data("xipos")[..., self.body, :] - ctx.data("subtree_com")[..., self.root, :]
        if (lever := self._lever(ctx)) is not None:
            arm = arm + lever
        a, b, c, *linear = components(spatial)
        return _total(linear, cross_parts((a, b, c), components(arm)))

    def push(self, ctx: Context, force: Array, out: Forces) -> None:
        """Add a force (..., 3), in the world, that acts on the hull."""
        wrench = out.xfrc[..., self.body, :]
        wrench[..., :3] += force
        if (lever := self._lever(ctx)) is not None:
            wrench[..., 3:] += joined(cross_parts(components(lever), components(force)))

    def _lever(self, ctx: Context) -> Array | None:
        """(..., 3) way from the centre of mass to the hull, in the world; None where they are one."""
        centre = ctx.nominal("body_ipos")[..., self.body, :]
        if centre.ndim == 1 and centre.tolist() == self._at:  # a single robot asks at every step: a sixth of the time
            return None
        away = self.hull - centre
        return joined(rotate_parts(self.quat(ctx), components(away))) if away.any() else None


def _total(a: Parts, b: Parts) -> Parts:
    x, y, z = a
    u, v, w = b
    return x + u, y + v, z + w


def translating(model: mujoco.MjModel) -> list[str]:
    """Bodies that rotors can carry: bases that move through the world."""
    return base_bodies(model)


def body_scales(model: mujoco.MjModel, scales: Scales, body: int) -> tuple[float, float]:
    """(force in N, speed in m/s) typical of a body: weight and measured force, and the speed of what translates it."""
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


class DragLinear(Effect):
    """Drag proportional to speed along each of the body's axes: F = -(x vx, y vy, z vz), on the hull."""

    family = "drag_linear"
    summary = "Linear air drag along the body's axes"
    PARAMS = tuple(Param(axis, "N s/m", 0.0, 1e3, probes=(0.1,)) for axis in "xyz")
    power = 1

    def bind(self, model: mujoco.MjModel) -> None:
        self.motions = [BodyMotion(model, int(b)) for b in body_ids(model, self.where)]

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        a, b, c = components(theta)
        for motion in self.motions:
            quat = motion.quat(ctx)
            x, y, z = motion.own_velocity(ctx, quat)
            scale = -root(x * x + y * y + z * z) if self.power == 2 else -1.0
            motion.push(ctx, joined(rotate_parts(quat, (scale * a * x, scale * b * y, scale * c * z))), out)

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        names = exposed_bodies(model)
        for name, b in zip(names, body_ids(model, names), strict=True):
            force, speed = body_scales(model, scales, int(b))
            unit = force / speed**cls.power
            size = {"probes": (0.1 * unit,), "high": 5 * unit, "resolution": 2e-3 * unit}
            out.append(cls((name,), sized(cls.PARAMS, x=size, y=size, z=size)))
        return out


class DragQuadratic(DragLinear):
    """Drag proportional to speed squared: F = -|v| (x vx, y vy, z vz) in the body's axes, on the hull."""

    family = "drag_quadratic"
    summary = "Quadratic air drag along the body's axes"
    PARAMS = tuple(Param(axis, "N s^2/m^2", 0.0, 1e3, probes=(0.1,)) for axis in "xyz")
    power = 2
