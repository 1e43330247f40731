"""Proposed laws of the motion: of a speed, a position, another part's speed, a command; and a trend in time."""

# ruff: noqa: D102  (hooks are documented once, in base.Effect and law.Law)

import mujoco
import numpy as np

from nfc_gym.physics.effects.base import Array, Context, Effect, Scales
from nfc_gym.physics.effects.drive import command_unit
from nfc_gym.physics.effects.generic import TIME
from nfc_gym.physics.effects.law import Law, OfVariable, degrees, kind_of, pushed, time_of, turns
from nfc_gym.physics.effects.lookup import actuator_ids, actuator_names, one_command_each
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.words import with_spread

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)


class _Linear(Law):
    """One size times one variable of the motion."""

    def variable(self, ctx: Context) -> Array:
        """(...,) what the force is proportional to."""
        raise NotImplementedError

    def basis(self, ctx: Context, shape: Array) -> Array:
        return self.variable(ctx)[..., None] * np.ones((*shape.shape[:-1], 1))

    @property
    def cause(self) -> str:
        """What it is proportional to, in words."""
        return self.where[-1]

    def say(self, theta: Array, sd: Array | None = None) -> str:
        size = f"{with_spread(theta[0], None if sd is None else sd[0])} {self.params[0].unit}"
        return f"A {self.noun} in proportion to {self.cause}: {size}."


class LawRamp(_Linear):
    """A force that grows with the time since the log began."""

    family = "law_ramp"
    summary = "A force that grows with time"
    PARAMS = (Param("rate", "N m/s", -1e6, 1e6, probes=(0.1,)),)

    @property
    def signals(self) -> tuple[str, ...]:
        return (TIME,)

    @property
    def what(self) -> str:
        return "f(t)"

    @property
    def cause(self) -> str:
        return "time"

    def variable(self, ctx: Context) -> Array:
        return time_of(self, ctx)

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        if TIME not in scales.exogenous:
            return []
        middle = max(float(scales.exogenous[TIME]), 1e-3)
        return [cls((p,), cls.sized(f / middle, f"{unit}/s")) for p, _, _, f, unit in pushed(model, scales)]


class LawCommand(_Linear):
    """A force in proportion to a command that is not meant to make it."""

    family = "law_command"
    summary = "A force in proportion to a command"
    PARAMS = (Param("size", "N m", -1e6, 1e6, probes=(0.1,)),)

    def _bind_variable(self, model: mujoco.MjModel) -> None:
        self.actuator = int(actuator_ids(model, self.where[1:])[0])

    def variable(self, ctx: Context) -> Array:
        return ctx.ctrl[..., self.actuator]

    @property
    def what(self) -> str:
        return f"f(ctrl_{self.where[1]})"

    @property
    def cause(self) -> str:
        return f"the command of {self.where[1]}"

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for place, dof, _, force, unit in pushed(model, scales):
            for i, name in enumerate(actuator_names(model) if one_command_each(model) else ()):
                if name and _tree(model, i) in (-1, int(model.dof_treeid[dof])):
                    of = command_unit(model, i)
                    size = force / max(float(scales.drive[i]), 1e-6)
                    out.append(cls((place, name), cls.sized(size, unit if of == "1" else f"{unit}/({of})")))
        return out


def _tree(model: mujoco.MjModel, actuator: int) -> int:
    """Kinematic tree of what an actuator drives, or -1 where that is not one joint or site."""
    kind, target = int(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator, 0])
    if kind in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
        return int(model.dof_treeid[model.jnt_dofadr[target]])
    if kind == int(mujoco.mjtTrn.mjTRN_SITE):
        return int(model.body_treeid[model.site_bodyid[target]])
    return -1


class LawCross(_Linear):
    """A force in proportion to the speed of another degree of freedom."""

    family = "law_cross"
    summary = "A force in proportion to another joint's speed"
    PARAMS = (Param("size", "N m s/rad", -1e6, 1e6, probes=(0.1,)),)

    def _bind_variable(self, model: mujoco.MjModel) -> None:
        self.other, _ = self._degree(model, self.where[1])

    def variable(self, ctx: Context) -> Array:
        return ctx.v[..., self.other]

    @property
    def what(self) -> str:
        return f"f(v_{self.where[1]})"

    @property
    def cause(self) -> str:
        return f"the speed of {self.where[1]}"

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for place, dof, _, force, unit in pushed(model, scales):
            for other, (its, _) in degrees(model).items():
                if other.endswith("@body") or its == dof or model.dof_treeid[its] != model.dof_treeid[dof]:
                    continue
                per = "s/rad" if turns(model, its) else "s/m"
                out.append(cls((place, other), cls.sized(force / max(float(scales.speed[its]), 1e-2), f"{unit} {per}")))
        return out


class LawPower(Law):
    """-level sign(v) |v|^power with v the speed of the degree of freedom itself."""

    family = "law_power"
    summary = "A force that goes with a power of the speed"
    PARAMS = (
        Param("level", "N m", -1e6, 1e6, probes=(0.1,)),
        Param("power", "1", 0.25, 5.0, probes=(0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0), shape=True),
    )

    def basis(self, ctx: Context, shape: Array) -> Array:
        v = ctx.v[..., self.dof]
        return (-np.sign(v) * np.abs(v) ** shape[..., 0])[..., None]

    def reach(self, ctx: Context, shape: Array) -> Array:
        return np.array([1.5])

    @property
    def what(self) -> str:
        return f"f(v_{self.where[0]})"

    def say(self, theta: Array, sd: Array | None = None) -> str:
        sides = "against" if theta[0] >= 0 else "along"
        wide = (None, None) if sd is None else (sd[0], sd[1])
        at = "1 rad/s" if self.params[0].unit == "N m" else "1 m/s"
        return (
            f"A {self.noun} {sides} its speed to the power {with_spread(theta[1], wide[1])}: "
            f"{with_spread(abs(theta[0]), wide[0])} {self.params[0].unit} at {at}."
        )

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        places = [p for p in pushed(model, scales) if not p[0].endswith("@body")]
        return [cls((p,), cls.sized(f, unit)) for p, _, _, f, unit in places]


class LawPolynomial(OfVariable):
    """A force that is a cubic of the joint's position about its zero: slope x + curvature x^2 + cubic x^3."""

    family = "law_polynomial"
    summary = "A force that bends with position"
    terms = 3
    PARAMS = tuple(Param(n, "N m", -1e6, 1e6, probes=(0.1,)) for n in ("slope", "curvature", "cubic"))

    def _bind_variable(self, model: mujoco.MjModel) -> None:
        super()._bind_variable(model)
        self.zero = float(model.qpos0[self.coordinate])

    def basis(self, ctx: Context, shape: Array) -> Array:
        x = self.variable(ctx) - self.zero
        return np.stack([x, x**2, x**3], -1) * np.ones((*shape.shape[:-1], 1))

    def say(self, theta: Array, sd: Array | None = None) -> str:
        sizes = zip(self.params, theta, (None,) * 3 if sd is None else sd, strict=True)
        parts = [f"{p.name} {with_spread(t, s)} {p.unit}" for p, t, s in sizes]
        return f"A {self.noun} that bends with its position: {', '.join(parts)}."

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for place, dof, q, force, unit in pushed(model, scales):
            if q is None or kind_of(model, dof) == _FREE:
                continue
            reach = max(scales.channels.get(f"joint:{place}:pos", (0.5, 0.0))[0], 1e-2)
            if reach < np.pi:  # beyond half a turn powers of an angle mean nothing
                of = "rad" if unit == "N m" else "m"
                out.append(cls((place,), cls.sized(force / reach, unit, (f"/{of}", f"/{of}^2", f"/{of}^3"))))
        return out
