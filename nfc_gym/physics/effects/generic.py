"""Generic alternatives: a smooth function of one variable, or of a joint's past, as a force on one degree of freedom.

They stand for whatever the library lacks. One that beats every named effect says where, and as a function of what, the
model is wrong, without a claim about the cause. `where` is a scalar joint, or one of the six components of a free
joint, written `name[0]` to `name[5]`.
"""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from typing import Any

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import TIME, Array, Context, Effect, Forces, Scales
from nfc_gym.physics.effects.hysteresis import dahl, excursion
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import joint_scales, sized, with_joint_units
from nfc_gym.physics.fields import names_of, object_id

_COUNT = 6
_FREE, _HINGE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_HINGE)


def coordinates(model: mujoco.MjModel) -> list[tuple[str, int, int | None]]:
    """(place, dof, coordinate) of named joints' degrees of freedom; rotations of a free joint lack a coordinate."""
    out: list[tuple[str, int, int | None]] = []
    for j, name in enumerate(names_of(model, mujoco.mjtObj.mjOBJ_JOINT, model.njnt)):
        dof, q = int(model.jnt_dofadr[j]), int(model.jnt_qposadr[j])
        kind = int(model.jnt_type[j])
        if name and kind >= int(mujoco.mjtJoint.mjJNT_SLIDE):
            out.append((name, dof, q))
        elif name and kind == _FREE:
            out += [(f"{name}[{i}]", dof + i, q + i if i < 3 else None) for i in range(6)]
    return out


class _Generic(Effect):
    """Force sum_k c_k phi_k(x): bumps of a Gaussian's shape over the variable's range, or waves for a turning joint."""

    generic = True
    PARAMS = tuple(Param(f"c{k}", "N m", -1e6, 1e6, probes=(0.1,)) for k in range(_COUNT))
    low_end, high_end, turning = -1.0, 1.0, False

    def bind(self, model: mujoco.MjModel) -> None:
        found = {place: (dof, q) for place, dof, q in coordinates(model)}
        if self.where[0] not in found:
            name = self.where[0].partition("[")[0]
            object_id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
            raise InputError(f"{self.family}: {self.where[0]!r} is no degree of freedom; there are: {', '.join(found)}")
        self.dof, self.coordinate = found[self.where[0]]
        self.params = with_joint_units(self.params, model, [self.dof])

    def variable(self, ctx: Context) -> Array:
        """(...,) what the force is a function of."""
        raise NotImplementedError

    def basis(self, x: Array) -> Array:
        """(..., 6) functions of x (...,)."""
        if self.turning:
            waves = np.arange(1, _COUNT // 2 + 1) * x[..., None]
            return np.concatenate([np.cos(waves), np.sin(waves)], -1)
        centres = np.linspace(self.low_end, self.high_end, _COUNT)
        width = (self.high_end - self.low_end) / (_COUNT - 1)
        return np.exp(-(((x[..., None] - centres) / width) ** 2))

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        out.qfrc[..., self.dof] += (theta * self.basis(self.variable(ctx))).sum(-1)

    @classmethod
    def _on(cls, model: mujoco.MjModel, place: str, dof: int, scales: Scales, low: float, high: float) -> "_Generic":
        force = max(float(scales.force[dof]), 1e-3)
        size = {"probes": (0.1 * force,), "low": -3 * force, "high": 3 * force}
        params = with_joint_units(cls.PARAMS, model, [dof])
        effect = cls((place,), sized(params, **{p.name: size for p in params}))
        effect.low_end, effect.high_end = low, high
        return effect


class GenericPosition(_Generic):
    """A force that depends on the position of its own degree of freedom."""

    family = "generic_position"
    summary = "A force that depends on position"

    def variable(self, ctx: Context) -> Array:
        return ctx.q[..., self.coordinate]

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for place, dof, q in coordinates(model):
            if q is None:
                continue
            joint = int(model.dof_jntid[dof])
            if model.jnt_limited[joint] and int(model.jnt_type[joint]) != _FREE:
                low, high = (float(e) for e in model.jnt_range[joint])
            else:
                low, high = _covered(model, scales, place, q)
            effect = cls._on(model, place, dof, scales, low, high)
            effect.turning = int(model.jnt_type[joint]) == _HINGE and not model.jnt_limited[joint]
            out.append(effect)
        return out


def _covered(model: mujoco.MjModel, scales: Scales, place: str, q: int) -> tuple[float, float]:
    """Ends of what a coordinate without limits covers, and a little more: never less than 2 m or rad.

    Bumps as narrow as the little that a body on the ground rises and falls would be functions of noise. Where the
    motion is unknown they lie about the model's own place; a craft that flies metres above it meets none of them there.
    """
    if scales.low is not None and scales.high is not None:
        low, high = float(scales.low[q]), float(scales.high[q])
        middle, reach = (low + high) / 2, max(0.6 * (high - low), 1.0)
    else:
        spread, _ = scales.channels.get(f"joint:{place}:pos", (0.0, 0.0))
        middle, reach = float(model.qpos0[q]), max(2.5 * spread, 1.0)
    return middle - reach, middle + reach


class GenericVelocity(_Generic):
    """A force that depends on the speed of its own degree of freedom."""

    family = "generic_velocity"
    summary = "A force that depends on speed"

    def variable(self, ctx: Context) -> Array:
        return ctx.v[..., self.dof]

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for place, dof, _ in coordinates(model):
            top = 2 * max(float(scales.speed[dof]), 1e-2)
            out.append(cls._on(model, place, dof, scales, -top, top))
        return out


class GenericTime(_Generic):
    """A force that depends on the time since the log began."""

    family = "generic_time"
    summary = "A force that depends on time"

    @property
    def signals(self) -> tuple[str, ...]:
        return (TIME,)

    def variable(self, ctx: Context) -> Array:
        if TIME not in ctx.exogenous:
            raise InputError(f"{self.family} reads the signal {TIME!r}, which the log does not carry")
        return ctx.exogenous[TIME]

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        if TIME not in scales.exogenous:
            return []
        end = max(2 * float(scales.exogenous[TIME]), 1e-3)  # the signal's median lies half-way through the log
        return [cls._on(model, place, dof, scales, 0.0, end) for place, dof, _ in coordinates(model)]


class GenericMemory(_Generic):
    """A force with memory in a joint, of whatever law: sum_k c_k w_k over two kinds of hidden states.

    The first three depend on the joint's way alone: elements that yield (Dahl's) within 3, 20 and 70 % of its
    excursion, of which a sum has a loop of any shape (a Maxwell-slip model, Iwan, J. Applied Mechanics 33, 1966). The
    others forget with time: the joint's speed, smoothed over 0.02, 0.1 and 0.4 s, as relaxing materials have it (a
    Prony series).
    """

    family = "generic_memory"
    summary = "A force with memory"
    YIELDING, FORGETTING = np.array([0.03, 0.2, 0.7]), np.array([0.02, 0.1, 0.4])
    reach, top = 1.0, 1.0

    def rest(self, ctx: Context, theta: Array) -> Any:
        return np.zeros((*ctx.v.shape[:-1], _COUNT))

    def follow(self, ctx: Context, theta: Array, memory: Any) -> Any:
        v, half = ctx.v[..., self.dof, None], _COUNT // 2
        yielding = dahl(memory[..., :half], v * ctx.dt, self.YIELDING * self.reach)
        keep = np.exp(-ctx.dt / self.FORGETTING)
        return np.concatenate([yielding, v / self.top + keep * (memory[..., half:] - v / self.top)], -1)

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        out.qfrc[..., self.dof] -= (theta * ctx.memory).sum(-1)

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for place, dof, _ in coordinates(model):
            if "[" in place:
                continue
            effect = cls._on(model, place, dof, scales, -1.0, 1.0)
            effect.reach, effect.top = excursion(model, scales, place), joint_scales(model, scales, (place,))[1]
            out.append(effect)
        return out
