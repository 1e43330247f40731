"""Drives that fade as they warm up."""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from nfc_gym.physics.effects.base import Array, Effect, Scales
from nfc_gym.physics.effects.drive import actuator_places, is_position, plain
from nfc_gym.physics.effects.lookup import actuator_ids, actuator_names, index, limited
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import sized
from nfc_gym.physics.effects.timing import command_limits
from nfc_gym.physics.recurrence import chased


class Thermal(Effect):
    """Commands times max(1 - fade h, 0); the heat h goes after (u / reference)^2, with u the command within its range:
    dh/dt = ((u / reference)^2 - h) / time_constant.

    One thermal mass heated by the losses of the winding, which go with the square of the current; the resistance that
    rises with it takes from the force. The heat starts settled at a log's or an episode's
    first command.
    """

    family = "thermal"
    summary = "Drive fades as it warms up"
    remark = "of a servo whose command is a speed, heat and fade are of that speed, as its current is not known"
    covers = ("loss", "gain")  # heat that hardly changes while the log lasts
    on_drive = True
    PARAMS = (
        Param("fade", "1", 0.0, 0.9, probes=(0.05, 0.2), resolution=0.002),
        Param("time_constant", "s", 0.05, 300.0, probes=(0.5, 3.0, 20.0), shape=True),
        Param("reference", "1", 1e-6, 1e6, probes=(1.0,), shape=True),
    )

    def bind(self, model: mujoco.MjModel) -> None:
        self.rows = index(actuator_ids(model, self.where))
        self.limits = command_limits(model, self.rows)

    def state0(self, shape: tuple[int, ...], ctrl: Array, theta: Array, dt: float) -> Any:
        return (self._received(ctrl) / theta[..., 2:3]) ** 2

    def _received(self, ctrl: Array) -> Array:
        """(..., n) what the drives are given of commands."""
        return limited(ctrl[..., self.rows], *self.limits)

    def span(self, theta: Array) -> float:
        return np.inf  # it warms up over minutes

    def action(
        self, ctrl: Array, theta: Array, memory: Any, exogenous: Mapping[str, Array], dt: float
    ) -> tuple[Array, Any]:
        target = self.state0((), ctrl, theta, dt)
        heat = target + np.exp(-dt / theta[..., 1:2]) * (memory - target)
        return self._faded(ctrl, theta, heat), heat

    def course(self, ctrl: Array, theta: Array, exogenous: Mapping[str, Array], dt: float) -> Array:
        each = theta[..., None, :]
        target = self.state0((), ctrl, each, dt)
        return self._faded(ctrl, each, chased(target, np.exp(-dt / theta[..., 1:2]), target[..., 0, :]))

    def _faded(self, ctrl: Array, theta: Array, heat: Array) -> Array:
        out = np.array(ctrl)
        out[..., self.rows] = self._received(ctrl) * np.maximum(1 - theta[..., 0:1] * heat, 0.0)
        return out

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        known = actuator_names(model)
        out: list[Effect] = []
        names = [n for n in plain(model) if not is_position(model, known.index(n))]  # whose goal is no current
        for where in actuator_places(model, names):
            size = max(float(np.max(scales.drive[[known.index(n) for n in where]])), 1e-6)
            # The reference only sets the unit of heat: free, it would be the fade under another name.
            fixed = {"probes": (size,), "low": size * (1 - 1e-3), "high": size * (1 + 1e-3)}
            out.append(cls(where, sized(cls.PARAMS, reference=fixed)))
        return out
