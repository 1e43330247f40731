"""How much force an actuator makes of its command: gain, loss of effectiveness, and the limit that speed sets."""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Array, Context, Effect, Forces, Scales
from nfc_gym.physics.effects.lookup import actuator_ids, actuator_names, groups, limited, one_command_each
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import scale_rows, sized
from nfc_gym.physics.fields import ModelFields

_FIXED, _AFFINE_GAIN = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)
_NO_BIAS, _AFFINE_BIAS = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)
_MUSCLE, _MUSCLE_BIAS = int(mujoco.mjtGain.mjGAIN_MUSCLE), int(mujoco.mjtBias.mjBIAS_MUSCLE)
_STRENGTH = slice(
    2, 4
)  # of a muscle's parameters: its peak force, and the scale that it is made of where it is not given
_INTEGRATOR = int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_TENDON = int(mujoco.mjtTrn.mjTRN_TENDON)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
ENDLESS = 1e12  # N or N m: a force that no actuator reaches, as good as no limit


def plain(model: mujoco.MjModel) -> list[str]:
    """Actuators whose force is gain * input + bias with constant or affine coefficients (motors and servos)."""
    if not one_command_each(model):
        return []
    return [
        n
        for i, n in enumerate(actuator_names(model))
        if int(model.actuator_gaintype[i]) in (_FIXED, _AFFINE_GAIN)
        and int(model.actuator_biastype[i]) in (_NO_BIAS, _AFFINE_BIAS)
    ]


def _muscles(model: mujoco.MjModel) -> list[str]:
    """Actuators whose active and passive force are a muscle's."""
    own = (model.actuator_gaintype == _MUSCLE) & (model.actuator_biastype == _MUSCLE_BIAS)
    return [n for n, muscle in zip(actuator_names(model), own, strict=True) if muscle]


def servos(model: mujoco.MjModel) -> list[str]:
    """Those of them whose force falls with what they move: position and velocity servos, motors with back-EMF."""
    known = actuator_names(model)
    affine, prm = model.actuator_biastype == _AFFINE_BIAS, model.actuator_biasprm
    return [n for n in plain(model) if affine[i := known.index(n)] and prm[i, 1:3].any()]


def is_position(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether the command is a position servo's goal; one that integrates its command (`intvelocity`) wants a speed."""
    return _holds(model, actuator) and not _integrates(model, actuator)


def _holds(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether the actuator's force falls with its own position, as a position servo's does."""
    return int(model.actuator_biastype[actuator]) == _AFFINE_BIAS and model.actuator_biasprm[actuator, 1] != 0


def _integrates(model: mujoco.MjModel, actuator: int) -> bool:
    return int(model.actuator_dyntype[actuator]) == _INTEGRATOR


def command_unit(model: mujoco.MjModel, actuator: int) -> str:
    """Unit of an actuator's command, read from its law: a position, a speed, or a share of its force.

    Of one that integrates its command it is that of the integral, per second.
    """
    unit = _input_unit(model, actuator)
    if not _integrates(model, actuator):
        return unit
    return f"{unit}^2" if unit.endswith("/s") else f"{unit}/s"


def _input_unit(model: mujoco.MjModel, actuator: int) -> str:
    """Unit of what an actuator's gain multiplies."""
    slides = moves_length(model, actuator)
    if slides is None:
        return "1"
    if _holds(model, actuator):
        return "m" if slides else "rad"
    # A motor on volts has back-EMF: a force that falls with speed too, but not as its gain times that speed.
    pull, drag = model.actuator_gainprm[actuator, 0], -model.actuator_biasprm[actuator, 2]
    if int(model.actuator_biastype[actuator]) == _AFFINE_BIAS and drag != 0 and np.isclose(pull, drag, rtol=1e-3):
        return "m/s" if slides else "rad/s"
    whole = model.actuator_gainprm[actuator, 0] == 1 and model.actuator_gear[actuator, 0] == 1
    if whole and int(model.actuator_trntype[actuator]) in _JOINTS:
        return "N" if slides else "N m"
    return "1"


def moves_length(model: mujoco.MjModel, actuator: int) -> bool | None:
    """Whether what an actuator moves is a length, in m; else it is an angle, or None: neither alone."""
    kind, arm = int(model.actuator_trntype[actuator]), arm_of(model, actuator)
    if arm is not None:
        each = {int(k) == _SLIDE for k in model.jnt_type[model.dof_jntid[arm != 0]]}
        return each.pop() if len(each) == 1 else None
    if kind in _JOINTS:
        return False  # of a ball or free joint
    return True if kind in (_TENDON, int(mujoco.mjtTrn.mjTRN_SLIDERCRANK)) else None  # a spatial tendon's length


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
    """Multiply everything that an actuator's force is made of, its limits included, by `factor` (...,).

    Of a muscle's parameters these are its strength alone, the others are lengths and speeds; it pulls or does nothing.
    """
    muscles = np.asarray(fields.nominal_model.actuator_gaintype)[rows] == _MUSCLE
    for name in ("actuator_gainprm", "actuator_biasprm"):
        if not muscles.all():
            scale_rows(fields, name, rows[~muscles], factor)
        if muscles.any():
            fields[name][..., rows[muscles], _STRENGTH] *= np.maximum(factor, 0.0)[..., None, None]
    scale_rows(fields, "actuator_forcerange", rows, factor)
    ranges = fields["actuator_forcerange"]
    ranges[..., rows, :] = np.sort(ranges[..., rows, :], -1)  # of a force turned round the lower end was the upper


def _scale_spec(spec: mujoco.MjSpec, names: Sequence[str], factor: float) -> None:
    for name in names:
        actuator = spec.actuator(name)
        muscle = int(actuator.gaintype) == _MUSCLE
        for key in ("gainprm", "biasprm"):
            values = np.array(getattr(actuator, key))
            if muscle and factor <= 0:
                values[_STRENGTH.start] = 0.0  # MJCF wants a scale above 0
            else:
                values[_STRENGTH if muscle else slice(None)] *= factor
            setattr(actuator, key, values)
        if factor != 0:  # no force at all needs no limit, and MJCF has none of zero width
            actuator.forcerange = np.sort(np.asarray(actuator.forcerange) * factor)


class Gain(Effect):
    """Force of the actuator times `gain`: a motor constant, a servo's stiffness, a muscle's strength."""

    family = "gain"
    summary = "Actuator force scaled"
    PARAMS = (Param("gain", "1", 0.2, 3.0, null=1.0, probes=(0.85, 1.15), resolution=0.005, floor=-np.inf),)

    def bind(self, model: mujoco.MjModel) -> None:
        self.rows = actuator_ids(model, self.where)
        fit = {*plain(model), *_muscles(model)}
        if unfit := [n for n in self.where if n not in fit]:
            raise InputError(
                f"{self.family}: what scales the force of {unfit[0]!r} is not known; actuators of which it is: "
                f"{', '.join(n for n in actuator_names(model) if n in fit) or 'none'}"
            )

    def factor(self, theta: Array) -> Array:
        """Force over nominal force, (...,)."""
        return theta[..., 0]

    def known_as(self, theta: Array) -> tuple[str, ...]:
        return ("loss",) if len(self.where) == 1 and 0 <= self.factor(theta) <= 1 else ()

    def model(self, fields: ModelFields, theta: Array) -> None:
        scale_force(fields, self.rows, self.factor(theta))

    def spec(self, spec: mujoco.MjSpec, theta: Array) -> bool:
        factor = float(self.factor(theta))
        # A servo's damping turned round is read as a damping ratio, which MJCF writes as a positive biasprm[2].
        actuators = [spec.actuator(name) for name in self.where]
        if factor < 0 and any(a.biasprm[2] < 0 and int(a.biastype) != _MUSCLE_BIAS for a in actuators):
            return False
        _scale_spec(spec, self.where, factor)
        return True

    def demand(self, force: Array, theta: Array, ctx: Context) -> Array:
        out = np.array(force)
        factor = self.factor(theta)
        out[..., self.rows] /= np.copysign(np.maximum(np.abs(factor), 1e-6), factor)[..., None]
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

    `peak` is what the model allows at rest (its force range, else the command range times the gain), as its parameters
    and other effects have it: a motor that lost half its force lost half its peak. `fall` is the share of it that is
    gone for each rad/s (m/s) of the joint or fixed tendon that the actuator moves, the inverse of the no-load speed.
    What exceeds the line, by the force of the substep before, is taken off there. Braking is not limited.
    """

    family = "torque_speed"
    summary = "Force limit that falls with speed"
    driven = True
    MODULATES = ("dof_damping",)
    PARAMS = (Param("fall", "s/rad", 0.0, 10.0, probes=(0.02, 0.1)),)

    def bind(self, model: mujoco.MjModel) -> None:
        self.rows = actuator_ids(model, self.where)
        arms = [arm_of(model, int(r)) for r in self.rows]
        for name, arm in zip(self.where, arms, strict=True):
            if arm is None:
                fit = [n for i, n in enumerate(actuator_names(model)) if arm_of(model, i) is not None]
                raise InputError(
                    f"torque_speed: {name!r} moves no hinge, slide or fixed tendon, whose speed would set its limit; "
                    f"actuators that do: {', '.join(fit) or 'none'}"
                )
        self.arms = np.array(arms)
        self.alone = np.array([on_scalar(model, int(r)) for r in self.rows])
        self.joints = self.arms * self.alone[:, None]
        self.reach = np.array([_reach(model, int(r)) for r in self.rows])

    def require_use(self, model: mujoco.MjModel, beside: Sequence[Effect]) -> None:
        peaks = _peak(partial(getattr, model), self.rows, self.reach)
        given = {name for e in beside if e.family == "saturation" for name in e.where}
        for name, peak in zip(self.where, peaks, strict=True):
            if peak == 0 and name not in given:
                raise InputError(
                    f"torque_speed: nothing limits the force of {name!r}, so that no limit of it falls with speed; "
                    "give the actuator a forcerange, or a motor a ctrlrange, or put `saturation` beside it"
                )

    def marks(self, model: mujoco.MjModel) -> dict[str, Array]:
        ends = (_reach(model, int(r)) for r in actuator_ids(model, self.where))
        return {_reach_mark(n): np.array([end]) for n, end in zip(self.where, ends, strict=True) if end > 0}

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        back, slope, speed = ctx.scratch.pop(self, None) or self._line(ctx, theta)
        out.qfrc[...] -= (back - slope * speed) @ self.arms

    def modulate(self, ctx: Context, theta: Array, fields: Mapping[str, Array]) -> None:
        ctx.scratch[self] = line = self._line(ctx, theta)
        fields["dof_damping"][...] += line[1] @ self.joints

    def _line(self, ctx: Context, theta: Array) -> tuple[Array, Array, Array]:
        """(force beyond the line, damping, speed) of what each actuator moves, (..., n) each.

        A light joint may cross the line within a step, and nothing would bring it back. There its force falls through
        the step from what it is, F at the speed v, to none at the no-load speed v0: F (v0 - v') / (v0 - v) at the speed
        v' in which the step ends, as a damping that MuJoCo's integrators take implicitly. One that moves evenly has F.
        """
        made = ctx.data("actuator_force")[..., self.rows]
        gear = ctx.nominal("actuator_gear")[..., self.rows, 0]
        peak, fall = _peak(ctx.nominal, self.rows, self.reach), theta[..., :1]
        speed = ctx.v @ self.arms.T
        driving = np.sign(made * gear) * speed
        lost = limited(fall * driving, 0.0, 1.0) * peak
        excess = limited(np.abs(made) - (peak - lost), 0.0, lost)
        push, room = np.abs(made) - excess, 1 - fall * driving  # room: share of the no-load speed that is left
        ahead = driving + ctx.dt * np.abs(gear) * push * (ctx.nominal("dof_invweight0") @ self.joints.T)
        crosses = (push > peak * (1 - fall * ahead)) & (room > 0) & (peak > 0) & self.alone
        slope = np.where(crosses, np.abs(gear) * push * fall / np.where(crosses, room, 1.0), 0.0)
        return np.sign(made) * excess * gear, slope, speed

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        known = actuator_names(model)
        if not plain(model):
            return []
        rows = np.arange(model.nu)
        peaks = _peak(partial(getattr, model), rows, np.array([_reach(model, int(r)) for r in rows]))
        fit = [n for n in plain(model) if peaks[known.index(n)] > 0]
        arms = {n: arm for n in fit if (arm := arm_of(model, known.index(n))) is not None}
        out: list[Effect] = []
        for where in actuator_places(model, list(arms)):
            speeds = [float(np.abs(arms[n]) @ scales.speed) for n in where]
            speed = max(float(np.median(speeds)), 1e-2)
            sizes = {"probes": (0.1 / speed, 0.4 / speed), "high": 2 / speed, "resolution": 0.01 / speed}
            out.append(cls(where, sized(cls.PARAMS, fall=sizes)))
        return out


def on_scalar(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator moves one hinge or slide joint."""
    if int(model.actuator_trntype[actuator]) not in _JOINTS:
        return False
    return int(model.jnt_type[model.actuator_trnid[actuator, 0]]) >= int(mujoco.mjtJoint.mjJNT_SLIDE)


def arm_of(model: mujoco.MjModel, actuator: int) -> Array | None:
    """(nv,) by which speeds add up to that of the hinge, slide or fixed tendon that an actuator moves; else None."""
    found, at = np.zeros(model.nv), int(model.actuator_trnid[actuator, 0])
    if on_scalar(model, actuator):
        found[model.jnt_dofadr[at]] = 1.0
        return found
    if int(model.actuator_trntype[actuator]) != _TENDON:
        return None
    parts = slice(int(model.tendon_adr[at]), int(model.tendon_adr[at] + model.tendon_num[at]))
    if (model.wrap_type[parts] != int(mujoco.mjtWrap.mjWRAP_JOINT)).any():
        return None  # a spatial tendon: its arms change as it moves
    for joint, coefficient in zip(model.wrap_objid[parts], model.wrap_prm[parts], strict=True):
        found[model.jnt_dofadr[joint]] += coefficient
    return found


def _reach_mark(name: str) -> str:
    """Name of the number by which a model says which command ruled an actuator's force before effects changed that."""
    return f"reach:{name}"


def _reach(model: mujoco.MjModel, actuator: int) -> float:
    """Largest input of an actuator whose force the range of its command alone limits, or of its integral; else 0."""
    mark = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, _reach_mark(actuator_names(model)[actuator]))
    if mark >= 0:
        return float(model.numeric_data[model.numeric_adr[mark]])
    if model.actuator_forcelimited[actuator] or int(model.actuator_biastype[actuator]) != _NO_BIAS:
        return 0.0
    kind = "act" if _integrates(model, actuator) else "ctrl"
    bounded = getattr(model, f"actuator_{kind}limited")[actuator]
    return float(np.abs(getattr(model, f"actuator_{kind}range")[actuator]).max()) if bounded else 0.0


def _peak(field: Callable[[str], Array], rows: NDArray[np.intp], reach: Array) -> Array:
    """Largest force (..., n) that a model allows actuators, 0 where it sets no limit.

    Args:
      field: the model's fields by name, (..., nu, *shape).
      rows: (n,) ids.
      reach: (n,) see `_reach`.
    """
    limited = field("actuator_forcelimited")[..., rows] != 0
    by_range = np.where(limited, np.abs(field("actuator_forcerange")[..., rows, :]).max(-1), ENDLESS)
    by_command = np.where(reach > 0, reach * np.abs(field("actuator_gainprm")[..., rows, 0]), ENDLESS)
    peak = np.minimum(by_range, by_command)
    return np.where(peak < ENDLESS, peak, 0.0)
