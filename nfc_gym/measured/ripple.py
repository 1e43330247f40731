"""What held commands do to a speed that positions tell: it ripples from row to row, and cubics do not see that.

A command that is held from row to row makes the drive's push a staircase, and the acceleration with it. The speed then
runs ahead of and behind the smooth curve through the positions, and at the rows, where the push jumps, it is always on
one side of it: under a command that climbs steadily by J of acceleration a row, J T / 12 behind after rows T apart. An
arm whose encoders are good shows that plainly, as a start speed that is off with each command, like a delay.
"""

import copy
from collections.abc import Mapping
from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.log import Log
from nfc_gym.measured.smoothing import POINTS
from nfc_gym.measured.states import States
from nfc_gym.physics.effects.sensors import RATES, SPEEDS
from nfc_gym.physics.segments import Servo

Array = NDArray[np.float64]

_MOMENTS = 20  # at which the push of a command is looked at
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)


def unrippled(
    model: mujoco.MjModel, log: Log, states: States, laws: Mapping[str, Servo], straight: frozenset[str] = frozenset()
) -> States:
    """States whose speeds, where slopes of positions tell them, are those at the rows and not of the curve.

    The ripple is what the model makes of the commands. A machine whose drives are late has it at another moment, which
    nobody knows yet: the whole of it counts as uncertain too.

    Args:
      model: its psi nominal.
      log, states: one log, and its states.
      laws: firmware servos by control.
      straight: controls that are interpolated between samples, which make no ripple.
    """
    sloped = _sloped(model, log)
    steps = _steps(model, log, states, laws, straight)
    if not sloped.any() or not steps.any():
        return states
    push = _push(model, log, states, np.sqrt((steps**2).mean(0)))
    ripple = np.where(sloped, _seen(steps @ push.T), 0.0)
    return replace(states, qvel=states.qvel - ripple, qvel_sd=np.hypot(states.qvel_sd, np.abs(ripple)))


def _sloped(model: mujoco.MjModel, log: Log) -> NDArray[np.bool_]:
    """(nv,) degrees of freedom whose position is measured at every row, and whose speed is not."""
    out = np.zeros(model.nv, bool)

    def told(position: str, speeds: tuple[str, ...]) -> bool:
        channel = log.channels.get(position)
        return channel is not None and channel.rate is None and not any(s in log.channels for s in speeds)

    for j in range(model.njnt):
        v, name = int(model.jnt_dofadr[j]), mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, j)
        if int(model.jnt_type[j]) == _FREE:
            body = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, int(model.jnt_bodyid[j]))
            out[v : v + 3] = told(f"body:{body}:pos", tuple(f"body:{body}:{s}" for s in SPEEDS))
            out[v + 3 : v + 6] = told(f"body:{body}:quat", tuple(f"body:{body}:{r}" for r in RATES))
        else:
            out[v] = told(f"joint:{name}:pos", (f"joint:{name}:vel",))
    return out


def _steps(
    model: mujoco.MjModel, log: Log, states: States, laws: Mapping[str, Servo], straight: frozenset[str]
) -> Array:
    """(T, nu) by how much each command steps at each row; a firmware servo's by its goal's step alone."""
    out = np.zeros((len(log), model.nu))
    for key, values in log.controls.items():
        if key in straight:
            continue
        made, before = values[1:], values[:-1]
        if key in laws:
            terms = {n: v[1:] for n, v in log.servo[key].items()}
            made, before = (laws[key].command(g, states.qpos[1:], states.qvel[1:], terms) for g in (made, before))
        actuator = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, key.removeprefix("ctrl:"))
        out[1:, actuator] = made - before
    return out


def _push(model: mujoco.MjModel, log: Log, states: States, size: Array) -> Array:
    """(nv, nu) by how much a unit step of each command offsets a speed, as of a steady climb: see `_share`.

    Args:
      size: (nu,) usual step of each command; one that never steps has no push.
    """
    out = np.zeros((model.nv, model.nu))
    rows = np.unique(np.linspace(0, len(log) - 1, _MOMENTS).astype(int))
    free, damped = (_Row(model, log.interval, each) for each in ("euler", "implicitfast"))
    ctrl = np.zeros((len(log), model.nu))
    for key, values in log.controls.items():
        if key not in log.servo:
            ctrl[:, mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, key.removeprefix("ctrl:"))] = values
    for row in rows:
        as_told = [m.after(states, row, ctrl[row]) for m in (free, damped)]
        for u in np.flatnonzero(size > 0):
            up = ctrl[row].copy()
            up[u] += size[u]
            first, last = (m.after(states, row, up) - was for m, was in zip((free, damped), as_told, strict=True))
            out[:, u] += _share(first, last) / size[u] / len(rows)
    return out


class _Row:
    """The model with a step as long as a row, and nothing that it could touch."""

    def __init__(self, model: mujoco.MjModel, dt: float, integrator: str) -> None:
        self._model = copy.copy(model)
        kind, flags, opt = mujoco.mjtIntegrator, mujoco.mjtDisableBit, self._model.opt
        opt.timestep = dt
        opt.integrator = int(kind.mjINT_EULER if integrator == "euler" else kind.mjINT_IMPLICITFAST)
        opt.disableflags |= int(flags.mjDSBL_CONSTRAINT) | int(flags.mjDSBL_EULERDAMP)
        self._data = mujoco.MjData(self._model)  # one for all rows: to make it takes longer than the step

    def after(self, states: States, row: int, ctrl: Array) -> Array:
        """(nv,) speeds one step later."""
        data = self._data
        mujoco.mj_resetData(self._model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = states.qpos[row], states.qvel[row], ctrl
        mujoco.mj_step(self._model, data)
        return np.asarray(data.qvel).copy()


def _share(free: Array, damped: Array) -> Array:
    """(nv,) offset of speeds at the rows of a steady climb, from what one step's push makes of them within a row.

    Of a speed that follows its goal by v' = (u - v) / tau, sampled each T = x tau, that is
    1 / (1 - exp(-x)) - 1/2 - 1/x of a step: T / 12 of its acceleration where it follows slowly, half of it where it is
    there before the next one. A step of T without damping makes it x, an implicit one with damping x / (1 + x).

    Args:
      free, damped: (nv,) change of the speeds after one row, without and with damping.
    """
    ratio = np.divide(free, damped, out=np.ones_like(free), where=np.abs(damped) > 1e-12 * np.abs(free).max())
    x = np.clip(ratio - 1, 0.0, 1e3)
    small = x < 1e-2
    big = np.where(small, 1.0, x)
    part = np.where(small, 1 / 12 - x**2 / 720, (1 / -np.expm1(-big) - 0.5 - 1 / big) / big)
    return free * part


def _seen(offset: Array) -> Array:
    """(T, nv) what cubics through the rows around make of offsets (T, nv) that belong to a steady climb by each step.

    A jump of the acceleration j rows away bends the positions from there on; the cubic's slope follows a part of that.
    """
    reach = POINTS // 2
    k = np.arange(-reach, reach + 1)
    slope = np.linalg.pinv(k[:, None] ** np.arange(4.0))[1]
    of = np.array([slope @ (np.square(np.maximum(k - abs(j), 0)) / 2) for j in k])
    of /= of.sum()
    padded = np.pad(offset, ((reach, reach), (0, 0)))
    return np.sum([w * padded[i : i + len(offset)] for i, w in enumerate(of)], 0)
