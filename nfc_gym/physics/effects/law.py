"""Proposed laws: what the misfit looks like where no named effect is shown to be its cause.

A law is a force on one degree of freedom, a few terms times a shape that is itself fitted: the order of a harmonic, the
power of a speed, the edges of a patch. It predicts and is saved like any effect, but says nothing of the cause.

`where` names the degree of freedom that is pushed: a scalar joint, one of the six components of a free joint
(`name[0]` to `name[5]`: along the world's axes, about the body's), or `name[0]@body` to `name[2]@body` for a push along
the body's axes; then, for laws of something else than the pushed degree's own motion, the name of that.
"""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import ClassVar

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Array, Context, Effect, Forces, Scales
from nfc_gym.physics.effects.generic import TIME, coordinates
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import turns
from nfc_gym.physics.state import rotate

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_AXES = np.eye(3)


def degrees(model: mujoco.MjModel) -> dict[str, tuple[int, int | None]]:
    """Every place that a law can push: name -> (dof, coordinate or None); for `@body` those of the world's axis."""
    out = {place: (dof, q) for place, dof, q in coordinates(model)}
    out |= {f"{p}@body": (dof, None) for p, (dof, q) in list(out.items()) if "[" in p and q is not None}
    return out


def kind_of(model: mujoco.MjModel, dof: int) -> int:
    """`mjtJoint` of the joint that a degree of freedom belongs to."""
    return int(model.jnt_type[model.dof_jntid[dof]])


def ends_of(x: Array) -> tuple[float, float]:
    """Nearly the whole range that a variable covers."""
    low, high = np.quantile(x, [0.005, 0.995])
    return float(low), float(max(high, low + 1e-9))


class Law(Effect):
    """Force sum_k c_k phi_k(motion; shape) on one degree of freedom.

    PARAMS hold the `terms` sizes c_k first, then the shape.
    """

    generic = True
    repeats = True  # what is pushed and what is read are named beside each other
    terms: ClassVar[int] = 1

    def bind(self, model: mujoco.MjModel) -> None:
        self.known = degrees(model)
        self.dof, _ = self._degree(model, self.where[0])
        joint = int(model.dof_jntid[self.dof])
        self.first, self.axis = int(model.jnt_dofadr[joint]), self.dof - int(model.jnt_dofadr[joint])
        self.quat = int(model.jnt_qposadr[joint]) + 3
        self.in_body = self.where[0].endswith("@body")
        self.turning = turns(model, self.dof)
        self._bind_variable(model)

    def _degree(self, model: mujoco.MjModel, name: str) -> tuple[int, int | None]:
        if name not in self.known:
            raise InputError(
                f"{self.family}: {name!r} is no degree of freedom; there are: {', '.join(self.known) or 'none'}"
            )
        return self.known[name]

    def _bind_variable(self, model: mujoco.MjModel) -> None:
        """Resolve what the law is a function of."""

    def basis(self, ctx: Context, shape: Array) -> Array:
        """(..., terms) functions phi_k for shapes (..., s) that broadcast against the context's arrays."""
        raise NotImplementedError

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        size = (theta[..., : self.terms] * self.basis(ctx, theta[..., self.terms :])).sum(-1)
        if self.in_body:
            out.qfrc[..., self.first : self.first + 3] += size[..., None] * self.direction(ctx)
        else:
            out.qfrc[..., self.dof] += size

    def direction(self, ctx: Context) -> Array:
        """(..., 3) world components of a unit push along the body's axis (only of a place `@body`)."""
        return rotate(ctx.q[..., self.quat : self.quat + 4], _AXES[self.axis])

    # ---- what a search needs ----------------------------------------------------------------------------------------

    def grid(self, ctx: Context) -> Array:
        """(G, s) shapes to look at on motions (S, T, ...)."""
        rows = list(product(*(p.probes for p in self.params[self.terms :])))
        return np.array(rows, float).reshape(len(rows), len(self.params) - self.terms)

    def reach(self, ctx: Context, shape: Array) -> Array:
        """(s,) how far each shape parameter may sensibly move from a value found on the grid."""
        return np.zeros(0)

    def least(self, ctx: Context) -> Array:
        """(s,) the least that each shape parameter may be on the motion at hand."""
        return np.array([p.low for p in self.params[self.terms :]])

    def at(self, ctx: Context, theta: Array) -> "Law":
        """The same law with probes at theta (k,) and bounds about it, for a fit that starts there."""
        params = []
        for p, value in zip(self.params[: self.terms], theta, strict=False):
            size = max(abs(value), max(abs(t) for t in theta[: self.terms]) * 0.1, 1e-9)
            params.append(replace(p, probes=(float(size),), low=-20 * float(size), high=20 * float(size)))
        shape = theta[self.terms :]
        shapes = zip(self.params[self.terms :], shape, self.reach(ctx, shape), self.least(ctx), strict=True)
        for p, value, room, least in shapes:
            low, high = max(least, value - room), min(p.high, value + room)
            params.append(replace(p, probes=(float(value),), low=float(low), high=float(high)))
        return type(self)(self.where, params)

    def again(self) -> "Law | None":
        """The law to look for where this one is at work already; None where one of its kind is enough."""
        return None

    @property
    def what(self) -> str:
        """What the force is a function of, as in `f(q_wheel)`."""
        return "f(?)"

    # ---- words ------------------------------------------------------------------------------------------------------

    @property
    def noun(self) -> str:
        """`torque on wheel`, `force on base along x`."""
        name, _, rest = self.where[0].partition("[")
        if not rest:
            return f"{'torque' if self.params[0].unit.startswith('N m') else 'force'} on {name}"
        i = int(rest[0])
        frame = "its own" if i > 2 or rest.endswith("@body") else "the world's"
        return f"{'force' if i < 3 else 'torque'} on {name} {'along' if i < 3 else 'about'} {frame} {'xyz'[i % 3]} axis"

    @classmethod
    def sized(cls, force: float, unit: str, per: Sequence[str] = ()) -> tuple[Param, ...]:
        """PARAMS with the sizes' unit (over `per` for each), and probes for a typical force."""
        units = [f"{unit}{p}" for p in per] or [unit] * cls.terms
        sizes = [
            replace(p, unit=u, probes=(0.1 * force,), low=-30 * force, high=30 * force)
            for p, u in zip(cls.PARAMS[: cls.terms], units, strict=True)
        ]
        return (*sizes, *cls.PARAMS[cls.terms :])


def pushed(model: mujoco.MjModel, scales: Scales) -> list[tuple[str, int, int | None, float, str]]:
    """(place, dof, coordinate, typical force, unit) of every place that a law can push."""
    return [
        (p, d, q, max(float(scales.force[d]), 1e-3), "N m" if turns(model, d) else "N")
        for p, (d, q) in degrees(model).items()
    ]


class OfVariable(Law):
    """A law of the coordinate that the last name in `where` says."""

    def _bind_variable(self, model: mujoco.MjModel) -> None:
        _, q = self._degree(model, self.where[-1].removesuffix("@body"))
        if q is None:
            raise InputError(
                f"{self.family}: {self.where[-1]!r} has no coordinate; name a joint, or a free joint's 0-2"
            )
        self.coordinate = q

    def variable(self, ctx: Context) -> Array:
        """(...,) what the law is a function of."""
        return ctx.q[..., self.coordinate]

    @property
    def what(self) -> str:
        return f"f(q_{self.where[-1].removesuffix('@body')})"


def time_of(law: Law, ctx: Context) -> Array:
    """(...,) seconds since the log began."""
    if TIME not in ctx.exogenous:
        raise InputError(f"{law.family} reads the signal {TIME!r}, which the log does not carry")
    return ctx.exogenous[TIME]
