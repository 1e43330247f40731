"""The forms that proposed laws take: of an angle, a speed, a position, a place, a height, time, a command."""

# ruff: noqa: D102  (hooks are documented once, in base.Effect and law.Law)

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Array, Context, Effect, Param, Scales, actuator_ids, actuator_names
from nfc_gym.physics.effects.drive import command_unit
from nfc_gym.physics.effects.generic import TIME
from nfc_gym.physics.effects.law import Law, degrees, pushed, spread, turns

_SLIDE, _HINGE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_STICK = 0.02  # m/s or rad/s over which a proposed dry friction turns from one side to the other
_EDGE = 0.05  # of a patch's length: how soft its edges are
_MOST = 1200  # values of one shape that are looked at


def _kind(model: mujoco.MjModel, dof: int) -> int:
    return int(model.jnt_type[model.dof_jntid[dof]])


def _ends(x: Array) -> tuple[float, float]:
    """Nearly the whole range that a variable covers."""
    low, high = np.quantile(x, [0.005, 0.995])
    return float(low), float(max(high, low + 1e-9))


class _OfVariable(Law):
    """A law of the coordinate that the last name in `where` says."""

    def _bind_variable(self, model: mujoco.MjModel) -> None:
        _, q = self._degree(model, self.where[-1].removesuffix("@body"))
        if q is None:
            raise InputError(f"{self.family}: {self.where[-1]!r} has no coordinate; name a joint, or a free joint's 0-2")
        self.coordinate = q

    def variable(self, ctx: Context) -> Array:
        """(...,) what the law is a function of."""
        return ctx.q[..., self.coordinate]

    @property
    def what(self) -> str:
        return f"f(q_{self.where[-1].removesuffix('@body')})"


class _Wave(Law):
    """cosine cos(x) + sine sin(x) with x = rate times a variable; the rate is the shape."""

    terms = 2

    def variable(self, ctx: Context) -> Array:
        """(...,) what repeats."""
        raise NotImplementedError

    def basis(self, ctx: Context, shape: Array) -> Array:
        x = shape[..., 0] * self.variable(ctx)
        return np.stack([np.cos(x), np.sin(x)], -1)

    def _resolution(self, ctx: Context) -> float:
        """Change of the rate that the motion at hand can tell."""
        low, high = _ends(self.variable(ctx))
        return 2 * np.pi / (high - low)

    def _rates(self, ctx: Context, low: float, high: float) -> Array:
        step = min(0.4 * self._resolution(ctx), 1.0)
        return np.arange(low, min(high, low + _MOST * step), step)

    def reach(self, ctx: Context, shape: Array) -> Array:
        return np.array([min(2 * self._resolution(ctx), 2.0)])

    def amplitude(self, theta: Array, sd: Array | None) -> str:
        """`0.31 ± 0.02 N m, phase 40 deg`: the force is largest where the repeating angle has that phase."""
        c, s = float(theta[0]), float(theta[1])
        size = float(np.hypot(c, s))
        wide = None if sd is None else float(np.hypot(c * sd[0], s * sd[1]) / max(size, 1e-12))
        phase = np.degrees(np.arctan2(s, c)) % 360
        return f"{size:.3g}{spread(size, wide)} {self.params[0].unit}, phase {phase:.0f} deg"


class LawHarmonic(_OfVariable, _Wave):
    """A force that repeats `order` times for each turn of a joint, its own or another one."""

    family = "law_harmonic"
    summary = "A force that repeats with a joint's angle"
    PARAMS = (
        Param("cosine", "N m", -1e6, 1e6, probes=(0.1,)),
        Param("sine", "N m", -1e6, 1e6, probes=(0.1,)),
        Param("order", "1", 0.05, 200.0, probes=(1.0, 2.0), shape=True),
    )

    def grid(self, ctx: Context) -> Array:
        if len(self.where) > 1:  # what one part's turning does to another: its unbalance, and twice that
            return np.array([[1.0], [2.0]])
        rates = self._rates(ctx, 0.5, 40.0)
        return np.union1d(rates, np.arange(1.0, 13.0))[:, None]

    def say(self, theta: Array, sd: Array | None = None) -> str:
        order, of = float(theta[2]), "" if len(self.where) == 1 else f" of {self.where[1]}"
        times = f"{round(order)} times" if abs(order - round(order)) < 0.01 else f"{order:.3g} times"
        times = "once" if times == "1 times" else times
        return f"A {self.noun} that repeats {times} a turn{of}: {self.amplitude(theta, sd)}."

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        places = pushed(model, scales)
        for place, dof, q, force, unit in places:
            sizes = cls.sized(force, unit)
            if q is not None and _kind(model, dof) == _HINGE:
                out.append(cls((place,), sizes))
            for other, (its, angle) in degrees(model).items():
                joint = int(model.dof_jntid[its])
                endless = angle is not None and _kind(model, its) == _HINGE and not model.jnt_limited[joint]
                if endless and its != dof and model.dof_treeid[its] == model.dof_treeid[dof]:
                    out.append(cls((place, other), sizes))
        return out


class LawWave(_Wave):
    """A force that swings at a frequency, with the time since the log began."""

    family = "law_wave"
    summary = "A force that swings with time"
    PARAMS = (
        Param("cosine", "N m", -1e6, 1e6, probes=(0.1,)),
        Param("sine", "N m", -1e6, 1e6, probes=(0.1,)),
        Param("rate", "rad/s", 0.01, 1000.0, probes=(1.0, 6.0), shape=True),
    )

    @property
    def signals(self) -> tuple[str, ...]:
        return (TIME,)

    @property
    def what(self) -> str:
        return "f(t)"

    def variable(self, ctx: Context) -> Array:
        return _time(self, ctx)

    def grid(self, ctx: Context) -> Array:
        return self._rates(ctx, self._resolution(ctx), 60.0)[:, None]

    def say(self, theta: Array, sd: Array | None = None) -> str:
        return f"A {self.noun} that swings at {theta[2] / (2 * np.pi):.3g} Hz: {self.amplitude(theta, sd)}."

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        if TIME not in scales.exogenous:
            return []
        return [cls((p,), cls.sized(f, unit)) for p, _, _, f, unit in pushed(model, scales)]


def _time(law: Law, ctx: Context) -> Array:
    if TIME not in ctx.exogenous:
        raise InputError(f"{law.family} reads the signal {TIME!r}, which the log does not carry")
    return ctx.exogenous[TIME]


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
        size = f"{theta[0]:.3g}{spread(theta[0], None if sd is None else sd[0])} {self.params[0].unit}"
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
        return _time(self, ctx)

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
            for i, name in enumerate(actuator_names(model)):
                if name and _tree(model, i) in (-1, int(model.dof_treeid[dof])):
                    of = command_unit(model, i)
                    size = force / max(float(scales.command[i]), 1e-6)
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
            f"A {self.noun} {sides} its speed to the power {theta[1]:.3g}{spread(theta[1], wide[1])}: "
            f"{abs(theta[0]):.3g}{spread(theta[0], wide[0])} {self.params[0].unit} at {at}."
        )

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        places = [p for p in pushed(model, scales) if not p[0].endswith("@body")]
        return [cls((p,), cls.sized(f, unit)) for p, _, _, f, unit in places]


class LawPolynomial(_OfVariable):
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
        parts = [f"{p.name} {t:.3g}{spread(t, s)} {p.unit}" for p, t, s in sizes]
        return f"A {self.noun} that bends with its position: {', '.join(parts)}."

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        for place, dof, q, force, unit in pushed(model, scales):
            if q is None or _kind(model, dof) == _FREE:
                continue
            reach = max(scales.channels.get(f"joint:{place}:pos", (0.5, 0.0))[0], 1e-2)
            if reach < np.pi:  # beyond half a turn powers of an angle mean nothing
                of = "rad" if unit == "N m" else "m"
                out.append(cls((place,), cls.sized(force / reach, unit, (f"/{of}", f"/{of}^2", f"/{of}^3"))))
        return out


class _Patch(_OfVariable):
    """A law that acts between two ends of a coordinate of the world, which its second name says."""

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
        low, high = _ends(self.variable(ctx))
        edges = np.linspace(low, high, 11)
        edges[[0, -1]] += np.array([-0.5, 0.5]) * (high - low)  # a step is a patch whose other end is out of sight
        return np.array([[a, b] for i, a in enumerate(edges) for b in edges[i + 1 :]][:-1])

    def reach(self, ctx: Context, shape: Array) -> Array:
        low, high = _ends(self.variable(ctx))
        return np.full(2, 0.3 * (high - low))

    @property
    def between(self) -> str:
        """`while joint x is between`."""
        return f"while {self.where[1]} is between"

    def say(self, theta: Array, sd: Array | None = None) -> str:
        size = f"{theta[0]:.3g}{spread(theta[0], None if sd is None else sd[0])} {self.params[0].unit}"
        return f"A {self.noun} {self.between} {theta[1]:.3g} and {theta[2]:.3g} {self.params[1].unit}: {size}."

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        places = degrees(model)
        for place, dof, _, force, unit in pushed(model, scales):
            for name, (its, q) in places.items():
                along = its - int(model.jnt_dofadr[model.dof_jntid[its]])
                horizontal = _kind(model, its) == _SLIDE or (_kind(model, its) == _FREE and along < 2)
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

    def basis(self, ctx: Context, shape: Array) -> Array:
        return (-np.tanh(ctx.v[..., self.dof] / _STICK) * self.window(ctx, shape))[..., None]

    @property
    def noun(self) -> str:
        return super().noun.replace("force", "friction").replace("torque", "friction")

    @property
    def what(self) -> str:
        return f"f(v_{self.where[0]}, q_{self.where[1]})"


class LawHeight(_OfVariable):
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
        size = f"{theta[0]:.3g}{spread(theta[0], None if sd is None else sd[0])} {self.params[0].unit}"
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
