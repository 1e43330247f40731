"""How much force an actuator makes of its command: gain, loss of effectiveness, and the limit that speed sets."""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.physics.effects.base import (
    Array,
    Context,
    Effect,
    Forces,
    Param,
    Scales,
    actuator_ids,
    actuator_names,
    groups,
)
from nfc_gym.physics.effects.places import scale_rows, sized
from nfc_gym.physics.fields import ModelFields

_FIXED, _AFFINE_GAIN = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)
_NO_BIAS, _AFFINE_BIAS = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)
_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT)


def plain(model: mujoco.MjModel) -> list[str]:
    """Named actuators whose force is gain * input + bias with constant or affine coefficients (motors and servos)."""
    return [
        n
        for i, n in enumerate(actuator_names(model))
        if n
        and int(model.actuator_gaintype[i]) in (_FIXED, _AFFINE_GAIN)
        and int(model.actuator_biastype[i]) in (_NO_BIAS, _AFFINE_BIAS)
    ]


def is_position(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether the actuator's force falls with its own position, as a position servo's does."""
    return int(model.actuator_biastype[actuator]) == _AFFINE_BIAS and model.actuator_biasprm[actuator, 1] != 0


def command_unit(model: mujoco.MjModel, actuator: int) -> str:
    """Unit of an actuator's command, read from its law: a position, a speed, or a share of its force."""
    slide = False
    if int(model.actuator_trntype[actuator]) == _JOINT:
        slide = int(model.jnt_type[model.actuator_trnid[actuator, 0]]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
    if is_position(model, actuator):
        return "m" if slide else "rad"
    if int(model.actuator_biastype[actuator]) == _AFFINE_BIAS and model.actuator_biasprm[actuator, 2] != 0:
        return "m/s" if slide else "rad/s"
    whole = model.actuator_gainprm[actuator, 0] == 1 and model.actuator_gear[actuator, 0] == 1
    if whole and int(model.actuator_trntype[actuator]) == _JOINT:
        return "N" if slide else "N m"
    return "1"


def actuator_places(model: mujoco.MjModel, names: Sequence[str]) -> list[tuple[str, ...]]:
    """Actuators alone, all together and in sets of like names; a place never mixes units of command."""
    known = actuator_names(model)
    out: list[tuple[str, ...]] = []
    units: dict[str, list[str]] = {}
    for name in names:
        units.setdefault(command_unit(model, known.index(name)), []).append(name)
    for alike in units.values():
        out += groups(alike)
    return out


def scale_force(fields: ModelFields, rows: NDArray[np.intp], factor: Array) -> None:
    """Multiply everything that an actuator's force is made of, its limits included, by `factor` (...,)."""
    for name in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"):
        scale_rows(fields, name, rows, factor)


def _scale_spec(spec: mujoco.MjSpec, names: Sequence[str], factor: float) -> None:
    for name in names:
        actuator = spec.actuator(name)
        for key in ("gainprm", "biasprm", "forcerange"):
            setattr(actuator, key, np.asarray(getattr(actuator, key)) * factor)


class Gain(Effect):
    """Force of the actuator times `gain`: a motor constant or servo stiffness other than the model's."""

    family = "gain"
    summary = "Actuator force scaled"
    PARAMS = (Param("gain", "1", 0.2, 3.0, null=1.0, probes=(0.85, 1.15), resolution=0.005, floor=-np.inf),)

    def bind(self, model: mujoco.MjModel) -> None:
        self.rows = actuator_ids(model, self.where)

    def factor(self, theta: Array) -> Array:
        """Force over nominal force, (...,)."""
        return theta[..., 0]

    def known_as(self, theta: Array) -> tuple[str, ...]:
        return ("loss",) if len(self.where) == 1 and 0 <= self.factor(theta) <= 1 else ()

    def model(self, fields: ModelFields, theta: Array) -> None:
        scale_force(fields, self.rows, self.factor(theta))

    def spec(self, spec: mujoco.MjSpec, theta: Array) -> bool:
        _scale_spec(spec, self.where, float(self.factor(theta)))
        return True

    def demand(self, force: Array, theta: Array, exogenous: Mapping[str, Array], dt: float) -> Array:
        out = np.array(force)
        out[..., self.rows] /= np.maximum(self.factor(theta), 1e-6)[..., None]
        return out

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        return [cls(where, cls.PARAMS) for where in actuator_places(model, plain(model))]


class Loss(Gain):
    """Share of an actuator's force that never arrives: 0 healthy, 1 a broken axle or dead motor. One actuator each."""

    family = "loss"
    summary = "Loss of actuator effectiveness"
    PARAMS = (Param("fraction", "1", 0.0, 1.0, probes=(0.15, 0.5, 0.95), resolution=0.005, natural=True),)

    def factor(self, theta: Array) -> Array:
        return 1.0 - theta[..., 0]

    def known_as(self, theta: Array) -> tuple[str, ...]:
        return ("gain",) if self.factor(theta) >= Gain.PARAMS[0].low else ()

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        return [cls((name,), cls.PARAMS) for name in plain(model)]


class TorqueSpeed(Effect):
    """Force limit that falls with speed in the driving direction: |force| <= peak (1 - fall * speed).

    `peak` is what the model allows at rest (its force range, else the command range times the gain); `fall` is the
    share of it that is gone for each rad/s (m/s), the inverse of the no-load speed. What exceeds the line, by the force
    of the substep before, is taken off at the joint. Braking is not limited.
    """

    family = "torque_speed"
    summary = "Force limit that falls with speed"
    PARAMS = (Param("fall", "s/rad", 0.0, 10.0, probes=(0.02, 0.1)),)

    def bind(self, model: mujoco.MjModel) -> None:
        self.rows = actuator_ids(model, self.where)
        self.dofs = np.array([model.jnt_dofadr[model.actuator_trnid[r, 0]] for r in self.rows], np.intp)
        self.gear = model.actuator_gear[self.rows, 0].copy()
        self.peak = np.array([_peak(model, int(r)) for r in self.rows])

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        made = ctx.data("actuator_force")[..., self.rows]
        driving = np.maximum(0.0, np.sign(made * self.gear) * ctx.v[..., self.dofs])
        lost = np.minimum(theta[..., :1] * driving, 1.0) * self.peak
        excess = np.clip(np.abs(made) - (self.peak - lost), 0.0, lost)
        for i, dof in enumerate(self.dofs):  # one joint may have several actuators
            out.qfrc[..., dof] -= np.sign(made[..., i]) * excess[..., i] * self.gear[i]

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        known = actuator_names(model)
        fit = [n for n in plain(model) if _peak(model, known.index(n)) > 0 and on_scalar(model, known.index(n))]
        out: list[Effect] = []
        for where in actuator_places(model, fit):
            dofs = [int(model.jnt_dofadr[model.actuator_trnid[known.index(n), 0]]) for n in where]
            speed = max(float(np.median(scales.speed[dofs])), 1e-2)
            sizes = {"probes": (0.1 / speed, 0.4 / speed), "high": 2 / speed, "resolution": 0.01 / speed}
            out.append(cls(where, sized(cls.PARAMS, fall=sizes)))
        return out


def on_scalar(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator moves one hinge or slide joint."""
    if int(model.actuator_trntype[actuator]) != _JOINT:
        return False
    return int(model.jnt_type[model.actuator_trnid[actuator, 0]]) >= int(mujoco.mjtJoint.mjJNT_SLIDE)


def _peak(model: mujoco.MjModel, actuator: int) -> float:
    """Largest force that the model allows the actuator, 0 where it sets no limit."""
    if model.actuator_forcelimited[actuator]:
        return float(np.abs(model.actuator_forcerange[actuator]).max())
    if model.actuator_ctrllimited[actuator] and int(model.actuator_biastype[actuator]) == _NO_BIAS:
        return float(np.abs(model.actuator_ctrlrange[actuator]).max() * abs(model.actuator_gainprm[actuator, 0]))
    return 0.0
