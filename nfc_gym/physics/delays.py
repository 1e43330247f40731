"""What MuJoCo's own delays of actuators let through, and their buffers at starts in the middle of a log."""

from collections.abc import Iterator, Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_NONE: Mapping[str, Array] = {}


def longest_delay(model: mujoco.MjModel) -> int:
    """Samples that the longest buffer of an actuator's native `delay` holds, 0 where there is none."""
    return int(np.max(model.actuator_history[:, 0], initial=0))


def delayed(model: mujoco.MjModel, commands: Sequence[Array], dt: float, fields: Mapping[str, Array] = _NONE) -> Array:
    """The command (..., nu) that MuJoCo's native delays let through of `commands`, the latest last."""
    late, last = list(_lateness(model, dt, fields)), len(commands) - 1
    if any(older.ndim for _, _, older in late):
        return _let_through(np.stack(commands, -2), late, np.array([last]))[..., 0, :]
    out = commands[-1].copy() if late else commands[-1]
    for i, share, older in late:
        old, young = (commands[max(last - age, 0)][..., i] for age in (int(older), int(older) - 1))
        out[..., i] = old + share * (young - old)
    return out


def delayed_course(model: mujoco.MjModel, ctrl: Array, dt: float, fields: Mapping[str, Array] = _NONE) -> Array:
    """What `delayed` lets through along a whole course of commands (..., T, nu); the first was held since ever."""
    return _let_through(ctrl, list(_lateness(model, dt, fields)), np.arange(ctrl.shape[-2]))


def _let_through(ctrl: Array, late: Sequence[tuple[int, Array, NDArray[np.intp]]], at: NDArray[np.intp]) -> Array:
    """(..., n, nu) at some steps (n,) of a course (..., T, nu)."""
    out = ctrl[..., at, :].copy()
    for i, share, older in late:
        own = np.broadcast_to(ctrl[..., i], (*np.broadcast_shapes(ctrl.shape[:-2], older.shape), ctrl.shape[-2]))
        ages = np.broadcast_to(older[..., None], (*own.shape[:-1], 1))
        old, young = (np.take_along_axis(own, np.clip(at - ages + k, 0, at), -1) for k in (0, 1))
        out[..., i] = old + share[..., None] * (young - old)
    return out


def _lateness(
    model: mujoco.MjModel, dt: float, fields: Mapping[str, Array]
) -> Iterator[tuple[int, Array, NDArray[np.intp]]]:
    """Actuators that delay commands, the share (...,) of the younger of two samples, and the older one's age, steps."""
    delay = fields.get("actuator_delay", model.actuator_delay)
    for i in np.flatnonzero(model.actuator_history[:, 0] > 0):
        steps = delay[..., i] / dt
        if (steps > 0).any():
            older = np.ceil(steps - 1e-9).astype(np.intp)
            yield int(i), older - steps if model.actuator_history[i, 1] else np.zeros_like(steps), older  # else held


def fill_delays(model: mujoco.MjModel, commands: Sequence[Array], history: Array) -> None:
    """Fill the buffers of actuators with a native `delay`, which MuJoCo leaves at zero.

    Args:
      commands: (..., nu) each, the latest last; the first is taken to have been held since ever.
      history: (..., nhistory) the `MjData` field of simulations that have not been stepped yet, written in place.
    """
    for i in range(model.nu):
        count, at = int(model.actuator_history[i, 0]), int(model.actuator_historyadr[i])
        for age in range(count):  # an actuator's part: two numbers, the samples' times, the samples, oldest first
            history[..., at + 2 + 2 * count - 1 - age] = commands[max(len(commands) - 1 - age, 0)][..., i]
