"""Proposed laws that repeat: with the angle of a joint, or with time."""

# ruff: noqa: D102  (hooks are documented once, in base.Effect and law.Law)

import mujoco
import numpy as np

from nfc_gym.physics.effects.base import Array, Context, Effect, Scales
from nfc_gym.physics.effects.generic import TIME
from nfc_gym.physics.effects.law import Law, OfVariable, degrees, ends_of, kind_of, pushed, time_of
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.words import with_spread

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_ROUND = 0.9 * 2 * np.pi  # rad: a turn, less what lies between samples where angles begin anew with each
_MOST = 1200  # values of one rate that are looked at


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
        low, high = ends_of(self.variable(ctx))
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
        return f"{with_spread(size, wide)} {self.params[0].unit}, phase {phase:.0f} deg"


class LawHarmonic(OfVariable, _Wave):
    """A force that repeats `order` times for each turn of a joint, its own or another one."""

    family = "law_harmonic"
    summary = "A force that repeats with a joint's angle"
    PARAMS = (
        Param("cosine", "N m", -1e6, 1e6, probes=(0.1,)),
        Param("sine", "N m", -1e6, 1e6, probes=(0.1,)),
        Param("order", "1", 0.05, 200.0, probes=(1.0, 2.0), shape=True),
    )

    def grid(self, ctx: Context) -> Array:
        if self._foreign:  # what one part's turning does to another: its unbalance, and twice that
            return np.array([[1.0], [2.0]])
        rates = self._rates(ctx, 0.5, 40.0)
        return np.union1d(rates, np.arange(1.0, 13.0))[:, None]

    @property
    def _foreign(self) -> bool:
        """Whether another joint than the pushed one turns."""
        return self.where[-1] != self.where[0]

    def again(self) -> Law | None:
        return None if len(self.where) > 1 else LawHarmonic(2 * self.where, self.params)  # a second harmonic

    def say(self, theta: Array, sd: Array | None = None) -> str:
        order, of = float(theta[2]), f" of {self.where[1]}" if self._foreign else ""
        times = f"{round(order)} times" if abs(order - round(order)) < 0.01 else f"{order:.3g} times"
        times = "once" if times == "1 times" else times
        return f"A {self.noun} that repeats {times} a turn{of}: {self.amplitude(theta, sd)}."

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        places = pushed(model, scales)
        for place, dof, q, force, unit in places:
            sizes = cls.sized(force, unit)
            if q is not None and kind_of(model, dof) == _HINGE:
                out.append(cls((place,), sizes))
            for other, (its, angle) in degrees(model).items():
                joint = int(model.dof_jntid[its])
                endless = kind_of(model, its) == _HINGE and not model.jnt_limited[joint]
                if (
                    angle is not None
                    and endless
                    and _turned(scales, angle)
                    and its != dof
                    and model.dof_treeid[its] == model.dof_treeid[dof]
                ):
                    out.append(cls((place, other), sizes))
        return out


def _turned(scales: Scales, angle: int) -> bool:
    """Whether a hinge went round in the logs, as far as is known: an arm that bends a little repeats nothing."""
    if scales.low is None or scales.high is None:
        return True
    return bool(scales.high[angle] - scales.low[angle] > _ROUND)


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
        return time_of(self, ctx)

    def grid(self, ctx: Context) -> Array:
        return self._rates(ctx, self._resolution(ctx), 60.0)[:, None]

    def least(self, ctx: Context) -> Array:
        # Slower, it would be no swing but any slow change there is.
        return np.maximum(super().least(ctx), self._resolution(ctx))

    def say(self, theta: Array, sd: Array | None = None) -> str:
        return f"A {self.noun} that swings at {theta[2] / (2 * np.pi):.3g} Hz: {self.amplitude(theta, sd)}."

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        if TIME not in scales.exogenous:
            return []
        return [cls((p,), cls.sized(f, unit)) for p, _, _, f, unit in pushed(model, scales)]
