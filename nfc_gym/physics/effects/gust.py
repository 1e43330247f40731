"""A gust: wind that rises and falls once."""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.air import BodyMotion, body_scales
from nfc_gym.physics.effects.base import TIME, Array, Context, Effect, Forces, Scales
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import body_ids, exposed_bodies, sized

_STARTS, _LENGTHS = (0.05, 0.25, 0.45, 0.65, 0.85), (0.1, 0.4)  # probed, as shares of a log


class Gust(Effect):
    """Force push (1 - cos(2 pi (t - start) / length)) / 2 on a body for start < t < start + length, else none.

    The one-minus-cosine gust of airworthiness practice (14 CFR 25.341(a), MIL-F-8785C 3.7.2) as the force at its peak,
    in the world on the hull; t is the time since the log or the episode began. Its impulse is
    push * length / 2.
    """

    family = "gust"
    covers = ("external_force",)  # one that outlasts the log
    summary = "Gust of wind"
    PARAMS = (
        *(Param(f"push_{axis}", "N", -1e5, 1e5, probes=(0.1,)) for axis in "xyz"),
        Param("start", "s", -1e4, 1e4, probes=(0.5,), shape=True),
        Param("length", "s", 1e-3, 1e4, probes=(0.5, 2.0), shape=True),
    )

    @property
    def signals(self) -> tuple[str, ...]:
        return (TIME,)

    def bind(self, model: mujoco.MjModel) -> None:
        self.motions = [BodyMotion(model, b) for b in body_ids(model, self.where).tolist()]

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        if TIME not in ctx.exogenous:
            raise InputError(f"{self.family} reads the signal {TIME!r}, which these segments do not carry")
        share = (ctx.exogenous[TIME] - theta[..., 3]) / theta[..., 4]
        strength = (1 - np.cos(2 * np.pi * np.minimum(np.maximum(share, 0.0), 1.0))) / 2
        for motion in self.motions:
            motion.push(ctx, theta[..., :3] * strength[..., None], out)

    def say(self, theta: Array, sd: Array | None = None) -> str:
        peak, along = float(np.linalg.norm(theta[:3])), ", ".join(f"{p:.3g}" for p in theta[:3])
        return (
            f"{self.summary} at {self.place}: from {theta[3]:.3g} s for {theta[4]:.3g} s, {peak:.3g} N at its peak "
            f"along ({along})."
        )

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        out: list[Effect] = []
        if TIME not in scales.exogenous:
            return out
        end = max(2 * float(scales.exogenous[TIME]), 1e-2)  # the median of time lies half-way through a log
        start = {"probes": tuple(s * end for s in _STARTS), "low": -end, "high": end}
        length = {"probes": tuple(s * end for s in _LENGTHS), "low": 0.01 * end, "high": 4 * end}
        names = exposed_bodies(model)
        for name, b in zip(names, body_ids(model, names), strict=True):
            force = body_scales(model, scales, int(b))[0]
            push = {"probes": (0.1 * force,), "low": -3 * force, "high": 3 * force, "resolution": 2e-3 * force}
            axes = {f"push_{axis}": push for axis in "xyz"}
            out.append(cls((name,), sized(cls.PARAMS, **axes, start=start, length=length)))
        return out
