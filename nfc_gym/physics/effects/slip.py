"""Wheels that grip less than their friction coefficient says, and differently across and along.

MuJoCo's contact friction is the same in both directions of a geom's surface (only `pair` elements have two
coefficients, and their directions do not turn with a wheel), and `geom_surfacevel` is a velocity imposed on the
surface, not a loss of grip. The effect therefore gives back, as a force at the contact patch, the share of the sliding
friction that the wheel does not have:

    F = mu N (lateral v_lat e_lat + longitudinal v_long e_long) / sqrt(|v|^2 + eps^2),

v the velocity of the patch over the ground, N an even share of the vehicle's weight, mu the contact's friction, eps
0.02 m/s. A patch that sticks (v = 0) is left to the solver.

Rubber also creeps before it slides: its sliding speed grows with the force. `creep` softens the tangential part of
every contact, `impratio / (1 + creep)`, so that the friction cone's edge is reached only at a finite sliding speed.
"""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Array, Context, Effect, Forces, Scales
from nfc_gym.physics.effects.lookup import groups
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.fields import ModelFields, names_of
from nfc_gym.physics.state import cross

_EPS = 0.02  # m/s: below it the patch is taken to stick
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_PLANE, _FIELD, _BOX = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{n}")) for n in ("PLANE", "HFIELD", "BOX"))
_GROUNDS = (_PLANE, _FIELD, _BOX)  # what vehicles stand on
_LEVEL = 0.5  # cosine of the angle by which an upper side may lean


def wheels(model: mujoco.MjModel) -> list[int]:
    """Geoms that touch the ground as wheels: colliding, about an unlimited hinge that is their body's only joint."""
    out = []
    for g in range(model.ngeom):
        body = int(model.geom_bodyid[g])
        if body == 0 or model.body_jntnum[body] != 1 or not (model.geom_contype[g] or model.geom_conaffinity[g]):
            continue
        joint = int(model.body_jntadr[body])
        if int(model.jnt_type[joint]) != _HINGE or model.jnt_limited[joint]:
            continue
        if int(model.body_rootid[body]) == body:
            continue  # a crank on the ground is no wheel of a vehicle
        away = np.linalg.norm(np.cross(model.geom_pos[g] - model.jnt_pos[joint], model.jnt_axis[joint]))
        if away < 0.2 * _radius(model, g):
            out.append(g)
    return out


def headed(ctx: Context, joints: NDArray[np.intp]) -> tuple[Array, Array, Array]:
    """Unit vectors ahead (..., n, 3), across (..., n, 3) and up (..., 1, 3) of wheels about hinges (n,)."""
    gravity = ctx.nominal("opt.gravity")
    weight = np.linalg.norm(gravity, axis=-1)
    up = (-gravity / np.maximum(weight, 1e-9)[..., None])[..., None, :]
    across = ctx.data("xaxis")[..., joints, :]
    across = _unit(across - (across * up).sum(-1, keepdims=True) * up)
    return cross(across, up), across, up


def _radius(model: mujoco.MjModel, geom: int) -> float:
    """Half extent of a geom across its body's hinge, m."""
    axis = np.zeros(3)
    mujoco.mju_rotVecQuat(
        axis, model.jnt_axis[int(model.body_jntadr[model.geom_bodyid[geom]])], _inverse(model.geom_quat[geom])
    )
    half = np.asarray(model.geom_aabb[geom]).reshape(-1)[3:]
    return float(np.sort(np.where(np.abs(axis) > 0.7, 0.0, half))[-1])


def _inverse(quat: Array) -> Array:
    out = np.zeros(4)
    mujoco.mju_negQuat(out, quat)
    return out


class Slip(Effect):
    """Shares of the sliding friction that are missing across and along the wheels; `ground` means every wheel."""

    family = "slip"
    summary = "Wheels grip less than their friction says"
    PARAMS = (
        # Natural: what both lack, the friction coefficient itself can give back.
        *(Param(n, "1", 0.0, 0.98, probes=(0.3,), resolution=0.005, natural=True) for n in ("lateral", "longitudinal")),
        Param("creep", "1", 0.0, 1e3, probes=(3.0, 30.0), resolution=0.1),
    )

    @classmethod
    def declare(cls, names: Sequence[str]) -> tuple[Param, ...]:
        """All three parameters for the ground, the first two for single wheels."""
        return cls.PARAMS[:2] if set(names) == {"lateral", "longitudinal"} else super().declare(names)

    def bind(self, model: mujoco.MjModel) -> None:
        found = wheels(model)
        if not found:
            raise InputError("slip: the model has no wheels (round colliding geoms on an unlimited hinge)")
        names = names_of(model, mujoco.mjtObj.mjOBJ_GEOM, model.ngeom)
        if self.where == ("ground",):
            self.geoms = found
        else:
            unknown = [n for n in self.where if n not in names]
            if unknown:
                raise InputError(
                    f"the model has no geom named {unknown[0]!r}; its wheels: {', '.join(names[g] for g in found)}"
                )
            self.geoms = [names.index(n) for n in self.where]
        geoms = np.array(self.geoms, np.intp)
        self.bodies = model.geom_bodyid[geoms].astype(np.intp)
        self.joints, self.roots = model.body_jntadr[self.bodies].astype(np.intp), model.body_rootid[self.bodies]
        self.radius = np.array([_radius(model, g) for g in self.geoms])
        # (nbody, wheels): the share of each body's weight that a wheel of its vehicle carries.
        carried = [model.body_rootid[model.geom_bodyid[o]] for o in found]
        self.load = np.stack([(model.body_rootid == r) / carried.count(r) for r in self.roots], 1)
        still = [g for g in range(model.ngeom) if int(model.body_weldid[model.geom_bodyid[g]]) == 0]
        solid = [g for g in still if model.geom_contype[g] or model.geom_conaffinity[g]]
        self.ground = [g for g in solid if int(model.geom_type[g]) in _GROUNDS] or solid[:1]

    def model(self, fields: ModelFields, theta: Array) -> None:
        if theta.shape[-1] < 3:
            return  # `impratio` is one number for all contacts: only the whole ground can creep
        ratio = fields["opt.impratio"]
        ratio[...] = ratio / (1 + theta[..., 2])

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        weight = np.linalg.norm(ctx.nominal("opt.gravity"), axis=-1)
        com = ctx.data("xipos")[..., self.bodies, :]
        ahead, across, up = headed(ctx, self.joints)
        arm = ctx.data("geom_xpos")[..., self.geoms, :] - com - self.radius[:, None] * up
        spatial = ctx.data("cvel")[..., self.bodies, :]
        from_root = com + arm - ctx.data("subtree_com")[..., self.roots, :]
        velocity = spatial[..., 3:] + cross(spatial[..., :3], from_root)
        lateral, along = (velocity * across).sum(-1), (velocity * ahead).sum(-1)
        normal = weight[..., None] * (ctx.nominal("body_mass") @ self.load)
        grip = self._friction(ctx) * normal / np.sqrt(lateral**2 + along**2 + _EPS**2)
        push = (grip * theta[..., 0:1] * lateral)[..., None] * across
        push += (grip * theta[..., 1:2] * along)[..., None] * ahead
        out.xfrc[..., self.bodies, :3] += push
        out.xfrc[..., self.bodies, 3:] += cross(arm, push)

    def _friction(self, ctx: Context) -> Array:
        """Sliding friction of the wheels' contact with what they stand on: of the geom of higher priority, else the
        larger."""
        friction, priority = ctx.nominal("geom_friction")[..., 0], ctx.model.geom_priority
        own = friction[..., self.geoms]
        if not self.ground:
            return own
        ground = np.array(self.ground)
        beneath = self._beneath(ctx) if len(ground) > 1 else np.zeros(own.shape, np.intp)
        floor = np.take_along_axis(np.broadcast_to(friction[..., ground], (*own.shape[:-1], len(ground))), beneath, -1)
        above = priority[ground][beneath] - priority[self.geoms]
        return np.where(above > 0, floor, np.where(above == 0, np.maximum(own, floor), own))

    def _beneath(self, ctx: Context) -> NDArray[np.intp]:
        """Which of `ground` each wheel stands on: the first surface below its centre, (..., wheels)."""
        wheels = ctx.data("geom_xpos")[..., self.geoms, :]
        places, frames = ctx.data("geom_xpos")[..., self.ground, :], ctx.data("geom_xmat")[..., self.ground, :]
        drops = []
        for i, g in enumerate(self.ground):
            frame = frames[..., i, :].reshape(*frames.shape[:-2], 1, 3, 3)
            at = ((wheels - places[..., i, None, :])[..., None] * frame).sum(-2)  # in the geom's own frame
            drops.append(np.where(frame[..., 2, 2] > _LEVEL, self._drop(ctx.model, g, at), np.inf))
        return np.stack(drops, -1).argmin(-1)

    @staticmethod
    def _drop(model: mujoco.MjModel, geom: int, at: Array) -> Array:
        """How far a geom's upper side lies below points (..., 3) of its frame, infinite where it does not, (...,)."""
        kind, size = int(model.geom_type[geom]), model.geom_size[geom]
        if kind == _PLANE:
            return np.where(at[..., 2] >= 0, at[..., 2], np.inf)
        top, extent = size[2], size[:2]
        if kind == _FIELD:
            h = int(model.geom_dataid[geom])
            shape, extent = (int(model.hfield_nrow[h]), int(model.hfield_ncol[h])), model.hfield_size[h, :2]
            first = int(model.hfield_adr[h])
            heights = model.hfield_data[first : first + shape[0] * shape[1]].reshape(shape) * model.hfield_size[h, 2]
            share = np.clip((at[..., :2] / extent + 1) / 2, 0, 1)
            row, column = (np.rint(share[..., k] * (n - 1)).astype(int) for k, n in ((1, shape[0]), (0, shape[1])))
            top = heights[row, column]
        over = (np.abs(at[..., :2]) <= extent).all(-1) & (at[..., 2] >= top)
        return np.where(over, at[..., 2] - top, np.inf)

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        names = names_of(model, mujoco.mjtObj.mjOBJ_GEOM, model.ngeom)
        named = [names[g] for g in wheels(model) if names[g]]
        if not wheels(model):
            return []
        places: Sequence[tuple[str, ...]] = [p for p in groups(named) if len(p) < len(named)] if named else []
        return [cls(("ground",), cls.PARAMS), *(cls(where, cls.PARAMS[:2]) for where in places)]


def _unit(v: Array) -> Array:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)
