"""Soil that wheels and feet sink into, and have to plough through."""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from collections.abc import Sequence

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Array, Context, Effect, Forces, Scales
from nfc_gym.physics.effects.ground import OnGround, ground_geoms, touching_geoms
from nfc_gym.physics.effects.lookup import groups
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.slip import wheels
from nfc_gym.physics.fields import ModelFields, names_of
from nfc_gym.physics.state import cross

_EPS = 0.02  # m/s: below it the resistance fades out, as it must for a vehicle at rest
_STEPS = 2.0  # in which it may stop a vehicle from there: in fewer it would throw one at rest to and fro


class Sinkage(OnGround):
    """What touches the ground rests `depth` below its surface; each wheel is held back by `resistance` times its load.

    The resistance R = c N acts on the wheel's body against its way over the ground, N an even share of the vehicle's
    weight: the work of pressing a rut. It fades out below 0.02 m/s, or below what it takes off in two steps. Bekker
    (Introduction to Terrain-Vehicle Systems, 1969, chapter 2) ties both for a rigid wheel of diameter D and a pressure
    proportional to depth: c = 3/4 sqrt(depth / D); a soft tyre or a bow wave adds to c, so both are free here. The
    depth is MuJoCo's contact `margin`, below zero by it. A machine without wheels has the depth alone, single wheels
    have the resistance alone.
    """

    family = "sinkage"
    summary = "Soft soil"
    PARAMS = (
        Param("depth", "m", 0.0, 0.2, probes=(0.003, 0.02), resolution=1e-4),
        Param("resistance", "1", 0.0, 1.0, probes=(0.03, 0.15), resolution=5e-4),
    )

    @classmethod
    def declare(cls, names: Sequence[str]) -> tuple[Param, ...]:
        """Both, or one of them."""
        chosen = tuple(p for p in cls.PARAMS if p.name in names)
        return chosen if chosen and len(chosen) == len(names) else super().declare(names)

    def bind(self, model: mujoco.MjModel) -> None:
        super().bind(model)
        at = {p.name: i for i, p in enumerate(self.params)}
        self.depth, self.resistance = (slice(at[n], at[n] + 1) if n in at else None for n in ("depth", "resistance"))
        rolling = wheels(model)
        chosen = [g for g in self.touching.tolist() if g in rolling]
        if self.resistance is not None and not chosen:
            raise InputError(
                "sinkage: `resistance` acts on wheels (round colliding geoms on an unlimited hinge); none here"
            )
        self.pressed = self.ground if self.where == ("ground",) else self.touching
        self.bodies = np.asarray(model.geom_bodyid)[chosen].astype(np.intp)
        self.roots = np.asarray(model.body_rootid)[self.bodies]
        carried = [model.body_rootid[model.geom_bodyid[g]] for g in rolling]
        shares = [(np.asarray(model.body_rootid) == r) / carried.count(r) for r in self.roots]
        self.load = np.stack(shares, 1) if shares else np.zeros((model.nbody, 0))

    def model(self, fields: ModelFields, theta: Array) -> None:
        if self.depth is None:
            return
        # Contacts are looked for where margin + gap >= 0, and carry load below the margin.
        fields["geom_margin"][..., self.pressed] -= theta[..., self.depth]
        fields["geom_gap"][..., self.pressed] += theta[..., self.depth]

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        if self.resistance is None:
            return
        gravity = ctx.nominal("opt.gravity")
        weight = np.linalg.norm(gravity, axis=-1)
        up = (-gravity / np.maximum(weight, 1e-9)[..., None])[..., None, :]
        spatial = ctx.data("cvel")[..., self.bodies, :]
        arm = ctx.data("xipos")[..., self.bodies, :] - ctx.data("subtree_com")[..., self.roots, :]
        velocity = spatial[..., 3:] + cross(spatial[..., :3], arm)
        velocity = velocity - (velocity * up).sum(-1, keepdims=True) * up
        normal = weight[..., None] * (ctx.nominal("body_mass") @ self.load)
        slow = np.maximum(_EPS, _STEPS * ctx.dt * theta[..., self.resistance] * weight[..., None])
        held = theta[..., self.resistance] * normal / np.sqrt((velocity * velocity).sum(-1) + slow * slow)
        out.xfrc[..., self.bodies, :3] -= held[..., None] * velocity

    def spec(self, spec: mujoco.MjSpec, theta: Array) -> bool:
        values = {p.name: float(t) for p, t in zip(self.params, theta, strict=True)}
        depth = values.get("depth", 0.0)
        if values.get("resistance", 0.0) != 0:
            return False
        for geom in spec.geoms:
            touches = geom.contype or geom.conaffinity
            if geom.name in self.where or (self.where == ("ground",) and touches and _still(geom.parent)):
                geom.margin -= depth
                geom.gap += depth
        return True

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        if not len(touching_geoms(model, ground_geoms(model))):
            return []
        rolling, names = wheels(model), names_of(model, mujoco.mjtObj.mjOBJ_GEOM, model.ngeom)
        if not rolling:
            return [cls(("ground",), cls.PARAMS[:1])]
        named = [names[g] for g in rolling if names[g]]
        parts = [p for p in groups(named) if len(p) < len(named)] if named else []
        return [cls(("ground",), cls.PARAMS), *(cls(where, cls.PARAMS[1:]) for where in parts)]


def _still(body: mujoco.MjsBody) -> bool:
    """Whether no joint lies between a body and the world."""
    while body.parent is not None:
        if body.joints:
            return False
        body = body.parent
    return True
