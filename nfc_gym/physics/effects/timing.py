"""Commands that arrive late: a first-order lag and a pure delay."""

# ruff: noqa: D102  (hooks are documented once, in base.Effect)

from collections.abc import Mapping
from functools import reduce
from operator import add
from typing import Any

import mujoco
import numpy as np

from nfc_gym.physics.effects.base import Array, Context, Effect, Scales
from nfc_gym.physics.effects.drive import actuator_places
from nfc_gym.physics.effects.lookup import Rows, actuator_ids, actuator_names, index, limited, one_command_each
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import sized
from nfc_gym.physics.effects.ranges import mixes, narrow_ranges, range_of
from nfc_gym.physics.recurrence import FORGOTTEN, chased

_STATELESS = int(mujoco.mjtDyn.mjDYN_NONE)
_ENDLESS = 2.0**53  # steps: more are no whole number of them
_LONGEST = 1e6  # steps that MuJoCo's buffer of an actuator may hold: it makes room for all of them at once


def command_limits(model: mujoco.MjModel, rows: Rows) -> tuple[Array, Array]:
    """(low, high) that MuJoCo itself clips the commands of some actuators to, infinite where it does not."""
    off = bool(model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL))
    limited = model.actuator_ctrllimited[rows].astype(bool) & (not off)
    low, high = model.actuator_ctrlrange[rows].T
    return np.where(limited, low, -np.inf), np.where(limited, high, np.inf)


class _Late(Effect):
    """What both share: the commands of some actuators, clipped as MuJoCo would, and a time in seconds."""

    def bind(self, model: mujoco.MjModel) -> None:
        self.rows = index(actuator_ids(model, self.where))
        self.limits = command_limits(model, self.rows)

    @staticmethod
    def _splits(spec: mujoco.MjSpec) -> bool:
        """Whether the spec's stages within a step would each see a filter or a buffer at another moment."""
        return int(spec.option.integrator) == int(mujoco.mjtIntegrator.mjINT_RK4)

    def _commands(self, ctrl: Array) -> Array:
        return limited(ctrl[..., self.rows], *self.limits)

    def _replace(self, ctrl: Array, values: Array) -> Array:
        out = ctrl.copy()
        out[..., self.rows] = values
        return out

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> list[Effect]:
        names = actuator_names(model) if one_command_each(model) else []
        # Under a sample and a half the logs say little; beyond 0.3 s no drive of a robot would be called late.
        probes = tuple(p for p in (0.01, 0.03, 0.08) if p > 0.4 * scales.interval) or (2 * scales.interval,)
        params = sized(cls.PARAMS, **{cls.PARAMS[0].name: {"probes": probes, "resolution": 0.05 * scales.interval}})
        return [cls(where, params) for where in actuator_places(model, names)]


class Lag(_Late):
    """First-order lag of the command: y <- u + exp(-dt / tau) (y - u), exact for commands held through a step."""

    family = "lag"
    summary = "First-order lag of the command"
    PARAMS = (Param("time_constant", "s", 0.0, 0.5, probes=(0.01, 0.03, 0.08)),)

    def state0(self, shape: tuple[int, ...], ctrl: Array, theta: Array, dt: float) -> Any:
        return self._commands(ctrl)

    def span(self, theta: Array) -> float:
        return FORGOTTEN * float(np.max(theta[..., 0], initial=0.0))

    def action(
        self, ctrl: Array, theta: Array, memory: Any, exogenous: Mapping[str, Array], dt: float
    ) -> tuple[Array, Any]:
        wish = self._commands(ctrl)
        made = wish + self._keep(theta, dt) * (memory - wish)
        return self._replace(ctrl, made), made

    def course(self, ctrl: Array, theta: Array, exogenous: Mapping[str, Array], dt: float) -> Array:
        wish = self._commands(ctrl)
        return self._replace(ctrl, chased(wish, self._keep(theta, dt), wish[..., 0, :]))

    @staticmethod
    def _keep(theta: Array, dt: float) -> Array:
        """(..., 1) share that a step leaves of what is still to come."""
        tau = theta[..., :1]
        return np.where(tau > 0, np.exp(-dt / np.maximum(tau, 1e-12)), 0.0)

    def demand(self, force: Array, theta: Array, ctx: Context) -> Array:
        # u = y + tau dy/dt, exactly; the rate by central differences
        out = np.array(force)
        out[:, self.rows] += theta[0] * np.gradient(force[:, self.rows], ctx.dt, axis=0)
        return out

    def spec(self, spec: mujoco.MjSpec, theta: Array) -> bool:
        actuators = [spec.actuator(n) for n in self.where]
        nominal = zip(*self.limits, strict=True)
        # MuJoCo clips before it filters: what clips to less than the filter was given would do so on the wrong side.
        clips = [range_of(a, "ctrl") for a in actuators]
        wider = all(r[0] <= low and high <= r[1] for r, (low, high) in zip(clips, nominal, strict=True))
        if any(int(a.dyntype) != _STATELESS for a in actuators) or not wider or self._splits(spec):
            return False
        # A delay after it mixes before MuJoCo clips: what is clipped here would then be mixed otherwise.
        if np.isfinite(self.limits).any() and any(mixes(spec, a) for a in actuators):
            return False
        narrow_ranges(spec, self.where, "ctrl", *self.limits)
        for actuator in actuators:
            actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
            actuator.dynprm = [float(theta[0]), *np.asarray(actuator.dynprm)[1:]]
            actuator.actearly = True  # a step's force already feels that step's command, as in `action`
        return True


class Delay(_Late):
    """Pure delay of the command. A delay between two steps mixes the two commands around it linearly.

    What is mixed is clipped, as MuJoCo's own delay is.
    """

    family = "delay"
    summary = "Delayed command"
    PARAMS = (Param("delay", "s", 0.0, 0.5, probes=(0.01, 0.03, 0.08)),)

    def state0(self, shape: tuple[int, ...], ctrl: Array, theta: Array, dt: float) -> Any:
        """What each past command weighs, and those that were seen so far, the latest first.

        Before the first of them its like was held since ever: a long delay keeps no more than there was.
        """
        return self._weights(theta, dt), [ctrl[..., self.rows]]

    @staticmethod
    def _weights(theta: Array, dt: float) -> dict[int, Array]:
        """(..., 1) of the commands that some simulation looks back to, by their ages in steps, in ascending order."""
        steps = np.minimum(theta[..., :1], _ENDLESS * dt) / dt
        whole = np.rint(steps)
        steps = np.where(np.abs(steps - whole) < 1e-9, whole, steps)
        ages = np.unique([np.floor(steps), np.ceil(steps)])
        return {int(age): np.maximum(0.0, 1.0 - np.abs(steps - age)) for age in ages}

    def action(
        self, ctrl: Array, theta: Array, memory: Any, exogenous: Mapping[str, Array], dt: float
    ) -> tuple[Array, Any]:
        weights, past = memory
        past = [ctrl[..., self.rows], *past[: max(weights)]]
        made = reduce(add, [w * past[min(age, len(past) - 1)] for age, w in weights.items()])
        return self._replace(ctrl, limited(made, *self.limits)), (weights, past)

    def course(self, ctrl: Array, theta: Array, exogenous: Mapping[str, Array], dt: float) -> Array:
        wish, at = ctrl[..., self.rows], np.arange(ctrl.shape[-2])
        weighed = ((age, w[..., None, :]) for age, w in self._weights(theta, dt).items())
        made = reduce(add, [w * wish[..., np.maximum(at - age, 0), :] for age, w in weighed])
        return self._replace(ctrl, limited(made, *self.limits))

    def demand(self, force: Array, theta: Array, ctx: Context) -> Array:
        out, time = np.array(force), np.arange(len(force)) * ctx.dt
        for a in np.arange(force.shape[1])[self.rows]:  # u(t) = y(t + delay); the last value is held
            out[:, a] = np.interp(time + theta[0], time, force[:, a])
        return out

    def spec(self, spec: mujoco.MjSpec, theta: Array) -> bool:
        dt, delay = spec.option.timestep, float(theta[0])
        actuators = [spec.actuator(n) for n in self.where]
        # MuJoCo reads its buffer before it writes, so that it knows no delay shorter than one step.
        if delay < dt * (1 - 1e-9) or any(a.delay > 0 or a.nsample > 0 for a in actuators):
            return False
        if delay > _LONGEST * dt or self._splits(spec) or not narrow_ranges(spec, self.where, "ctrl", *self.limits):
            return False
        for actuator in actuators:
            actuator.delay = delay
            actuator.nsample = int(np.ceil(delay / dt - 1e-9)) + 1
            actuator.interp = 1  # linear
        return True
