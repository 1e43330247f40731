"""Forces from outside: a constant push, steady wind, and gravity that does not point down the model's z."""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from collections.abc import Sequence

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.air import BodyMotion, body_scales
from nfc_gym.physics.effects.base import Array, Context, Effect, Forces, Scales
from nfc_gym.physics.effects.lookup import index, joint_dofs
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import (
    body_ids,
    exposed_bodies,
    force_unit,
    joint_places,
    joint_scales,
    sized,
    with_joint_units,
    with_units,
)
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.state import components, joined, rotate, vector_to_quat


class ExternalForce(Effect):
    """A constant force: (x, y, z) in the world on a body's hull, or one number along a joint (a preload)."""

    family = "external_force"
    summary = "Constant external force"
    PARAMS = tuple(Param(axis, "N", -1e5, 1e5, probes=(0.1,), ambient=True) for axis in "xyz")
    ON_JOINT = (Param("force", "N m", -1e5, 1e5, probes=(0.1,)),)

    @classmethod
    def declare(cls, names: Sequence[str]) -> tuple[Param, ...]:
        return cls.ON_JOINT if tuple(names) == ("force",) else super().declare(names)

    @property
    def on_joint(self) -> bool:
        """Whether it acts along joints rather than on bodies."""
        return self.params[0].name == "force"

    def bind(self, model: mujoco.MjModel) -> None:
        dofs = joint_dofs(model, self.where if self.on_joint else ())
        self.dofs = index(dofs) if self.on_joint else slice(0)
        self.params = with_joint_units(self.params, model, dofs) if self.on_joint else self.params
        self.motions = [] if self.on_joint else [BodyMotion(model, b) for b in body_ids(model, self.where).tolist()]

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        if self.on_joint:
            out.qfrc[..., self.dofs] += theta
        for motion in self.motions:
            motion.push(ctx, theta, out)

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        bodies = exposed_bodies(model, arms=True)
        for name, b in zip(bodies, body_ids(model, bodies), strict=True):
            force = body_scales(model, scales, int(b))[0]
            size = {"probes": (0.05 * force,), "low": -2 * force, "high": 2 * force, "resolution": 1e-3 * force}
            out.append(cls((name,), sized(cls.PARAMS, x=size, y=size, z=size)))
        for where in joint_places(model):
            if len(where) == 1 and where[0] in bodies:
                continue  # two candidates of one id could not be told apart
            force, _ = joint_scales(model, scales, where)
            size = {"probes": (0.1 * force,), "low": -3 * force, "high": 3 * force, "resolution": 2e-3 * force}
            out.append(cls(where, with_units(sized(cls.ON_JOINT, force=size), {"force": force_unit(model, where[0])})))
        return out


_GALE = 113.0  # m/s; the strongest gust measured near the ground (WMO)


class Wind(Effect):
    """Steady wind on a body: F = push - drag v, in the world, on the hull.

    It is drag relative to air that moves at push / drag, written so that the force is linear in all four parameters: a
    body that moves with the wind feels nothing, a body at rest feels `push`.
    """

    family = "wind"
    covers = ("external_force", "drag_linear")  # a gale on hardly any drag; still air (one drag for all axes)
    summary = "Steady wind"
    lone = True
    PARAMS = (
        *(Param(f"push_{axis}", "N", -1e5, 1e5, probes=(0.1,), ambient=True) for axis in "xyz"),
        Param("drag", "N s/m", 0.0, 1e4, probes=(0.1,)),
    )

    def bind(self, model: mujoco.MjModel) -> None:
        self.motion = BodyMotion(model, int(body_ids(model, self.where)[0]))

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        *push, drag = components(theta)
        velocity = self.motion.velocity(ctx, self.motion.quat(ctx))
        self.motion.push(ctx, joined([p - drag * v for p, v in zip(push, velocity, strict=True)]), out)

    def say(self, theta: Array, sd: Array | None = None) -> str:
        wind = theta[:3] / max(theta[3], 1e-300)
        speed = float(np.linalg.norm(wind))
        # Of a push without a drag that is surely there the speed of the air is not known.
        if theta[3] <= (0 if sd is None else 2 * sd[3]) or speed > _GALE:
            return super().say(theta, sd)
        heading = ", ".join(f"{w:.2g}" for w in wind / max(speed, 1e-300))
        return f"{self.summary} at {self.place}: {speed:.3g} m/s along ({heading}), drag {theta[3]:.3g} N s/m."

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        names = exposed_bodies(model)
        for name, b in zip(names, body_ids(model, names), strict=True):
            force, speed = body_scales(model, scales, int(b))
            push = {"probes": (0.05 * force,), "low": -2 * force, "high": 2 * force, "resolution": 1e-3 * force}
            drag = {"probes": (0.1 * force / speed,), "high": 5 * force / speed, "resolution": 2e-3 * force / speed}
            out.append(cls((name,), sized(cls.PARAMS, push_x=push, push_y=push, push_z=push, drag=drag)))
        return out


class Slope(Effect):
    """Gravity turned about the world's x (`roll`) and y (`pitch`): a tilted floor, or a base that is not mounted level.

    A positive pitch pulls towards -x, as on a floor that rises along x; a positive roll pulls towards +y.
    """

    family = "slope"
    summary = "Gravity tilted against the model's vertical"
    PARAMS = (
        Param("roll", "rad", -0.6, 0.6, probes=(0.05,), resolution=1e-3, ambient=True),
        Param("pitch", "rad", -0.6, 0.6, probes=(0.05,), resolution=1e-3, ambient=True),
    )

    def bind(self, model: mujoco.MjModel) -> None:
        """See `Effect`; it sits in the world and nowhere else."""
        super().bind(model)
        if self.where != ("world",):
            raise InputError(f"slope: `where` is {'+'.join(self.where)!r}, want 'world'")

    def model(self, fields: ModelFields, theta: Array) -> None:
        gravity = fields["opt.gravity"]
        gravity[...] = rotate(_tilt(theta), gravity)

    def spec(self, spec: mujoco.MjSpec, theta: Array) -> bool:
        spec.option.gravity = rotate(_tilt(theta), np.asarray(spec.option.gravity))
        return True

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        return [cls(("world",), cls.PARAMS)] if np.any(model.opt.gravity) else []


def _tilt(theta: Array) -> Array:
    return vector_to_quat(np.concatenate([theta, np.zeros_like(theta[..., :1])], -1))
