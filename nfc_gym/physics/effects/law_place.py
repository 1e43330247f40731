"""Proposed laws of the place: a patch that pushes, a patch of other friction, a push that fades with height."""

# ruff: noqa: D102  (hooks are documented once, in base.Effect and law.Law)

import mujoco
import numpy as np

from nfc_gym.physics.effects.base import Array, Context, Effect, Scales
from nfc_gym.physics.effects.ground import ground_geoms, touching_geoms
from nfc_gym.physics.effects.law import OfVariable, degrees, ends_of, kind_of, pushed
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.words import with_spread

_SLIDE, _FREE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_FREE)
_STICK = 0.02  # m/s or rad/s over which a proposed dry friction turns from one side to the other
_EDGE = 0.05  # of a patch's length: how soft its edges are


class _Patch(OfVariable):
    """A law that acts between two ends of a coordinate of the world, which its second name says."""

    remark = f"its edges are soft over {100 * _EDGE:g} % of its length"
    PARAMS = (
        Param("level", "N", -1e6, 1e6, probes=(0.1,)),
        Param("start", "m", -1e4, 1e4, probes=(0.0, 1.0), shape=True),
        Param("end", "m", -1e4, 1e4, probes=(0.5, 1.5), shape=True),
    )

    def window(self, ctx: Context, shape: Array) -> Array:
        """(...,) 1 between the ends and 0 outside, with soft edges."""
        start, end = shape[..., 0], shape[..., 1]
        edge = _EDGE * np.abs(end - start) + 1e-6
        x = self.variable(ctx)
        return 0.5 * (np.tanh((x - start) / edge) - np.tanh((x - end) / edge))

    def grid(self, ctx: Context) -> Array:
        low, high = ends_of(self.variable(ctx))
        edges = np.linspace(low, high, 11)
        edges[[0, -1]] += np.array([-0.5, 0.5]) * (high - low)  # a step is a patch whose other end is out of sight
        return np.array([[a, b] for i, a in enumerate(edges) for b in edges[i + 1 :]][:-1])

    def reach(self, ctx: Context, shape: Array) -> Array:
        low, high = ends_of(self.variable(ctx))
        return np.full(2, 0.3 * (high - low))

    @property
    def between(self) -> str:
        """`while joint x is between`."""
        return f"while {self.where[1]} is between"

    def say(self, theta: Array, sd: Array | None = None) -> str:
        size = f"{with_spread(theta[0], None if sd is None else sd[0])} {self.params[0].unit}"
        return f"A {self.noun} {self.between} {theta[1]:.3g} and {theta[2]:.3g} {self.params[1].unit}: {size}."

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        places = degrees(model)
        trees = model.body_treeid[model.geom_bodyid[touching_geoms(model, ground_geoms(model))]]
        for place, dof, _, force, unit in pushed(model, scales):
            for name, (its, q) in places.items():
                along = its - int(model.jnt_dofadr[model.dof_jntid[its]])
                # Nothing is at a place in the air: what seems so stands for where along its path a craft was.
                on_ground = kind_of(model, its) == _FREE and along < 2 and model.dof_treeid[its] in trees
                horizontal = kind_of(model, its) == _SLIDE or on_ground
                same = model.dof_treeid[its] == model.dof_treeid[dof]
                if q is not None and horizontal and same and not place.endswith("@body"):
                    out.append(cls((place, name), cls.sized(force, unit)))
        return out


class LawPlace(_Patch):
    """A push that acts only in one part of the world."""

    family = "law_place"
    summary = "A force that acts in one place"

    def basis(self, ctx: Context, shape: Array) -> Array:
        return self.window(ctx, shape)[..., None]


class LawFrictionByPlace(_Patch):
    """A dry friction that acts, or is missing, only in one part of the world."""

    family = "law_friction"
    summary = "A friction that differs in one place"
    remark = f"{_Patch.remark}, and it turns over within {_STICK:g} m/s or rad/s"

    def basis(self, ctx: Context, shape: Array) -> Array:
        return (-np.tanh(ctx.v[..., self.dof] / _STICK) * self.window(ctx, shape))[..., None]

    @property
    def noun(self) -> str:
        return super().noun.replace("force", "friction").replace("torque", "friction")

    @property
    def what(self) -> str:
        return f"f(v_{self.where[0]}, q_{self.where[1]})"


class LawHeight(OfVariable):
    """A push that fades with height: level / (1 + (z / height)^2)."""

    family = "law_height"
    summary = "A force that fades with height"
    PARAMS = (
        Param("level", "N", -1e6, 1e6, probes=(0.1,)),
        Param("height", "m", 0.01, 100.0, probes=(0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2), shape=True),
    )

    def _bind_variable(self, model: mujoco.MjModel) -> None:
        super()._bind_variable(model)
        joint = int(model.dof_jntid[self.dof])
        free = int(model.jnt_type[joint]) == _FREE
        self.ground = 0.0 if free else float(model.qpos0[self.coordinate] - model.body_pos[model.jnt_bodyid[joint], 2])

    def basis(self, ctx: Context, shape: Array) -> Array:
        z = np.maximum(self.variable(ctx) - self.ground, 0.0)
        return (1 / (1 + (z / shape[..., 0]) ** 2))[..., None]

    def reach(self, ctx: Context, shape: Array) -> Array:
        return np.array([2.0 * shape[0]])

    @property
    def what(self) -> str:
        return "f(z)"

    def say(self, theta: Array, sd: Array | None = None) -> str:
        size = f"{with_spread(theta[0], None if sd is None else sd[0])} {self.params[0].unit}"
        return f"A {self.noun} that fades with height: {size} on the ground, half of it at {theta[1]:.3g} m."

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for place, dof, _, force, unit in pushed(model, scales):
            joint = int(model.dof_jntid[dof])
            body, kind = int(model.jnt_bodyid[joint]), int(model.jnt_type[joint])
            lifts = kind == _FREE and dof - int(model.jnt_dofadr[joint]) == 2
            upright = kind == _SLIDE and int(model.body_parentid[body]) == 0 and abs(model.jnt_axis[joint, 2]) > 0.99
            if lifts or upright:
                out.append(cls((place,), cls.sized(force, unit)))
        return out
