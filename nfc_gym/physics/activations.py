"""What MuJoCo keeps of past commands, made for roll-outs that start in the middle of a log."""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Activations:
    """First-order actuator states of a model, stepped outside of a simulation.

    Args:
      model: MuJoCo's dynamics of the types `filter` and `filterexact` are followed, and taken as exact.
      dt: step, s.
    """

    def __init__(self, model: mujoco.MjModel, dt: float) -> None:
        kinds = [int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)]
        self._of = np.flatnonzero(np.isin(model.actuator_dyntype, kinds))
        self._at = model.actuator_actadr[self._of]
        limited = model.actuator_ctrllimited[self._of].astype(bool)
        self._low, self._high = (
            np.where(limited, model.actuator_ctrlrange[self._of, side], np.inf * sign)
            for side, sign in ((0, -1), (1, 1))
        )
        self._keep = np.exp(-dt / np.maximum(model.actuator_dynprm[self._of, 0], 1e-9))

    def __bool__(self) -> bool:
        """Whether the model has any."""
        return len(self._of) > 0

    def advance(self, ctrl: Array, act: Array, settle: bool = False) -> None:
        """One step of the states (..., na) under commands (..., nu), in place; `settle`: held for ever."""
        if self:
            target = np.clip(ctrl[..., self._of], self._low, self._high)
            act[..., self._at] = target if settle else target + self._keep * (act[..., self._at] - target)


def longest_delay(model: mujoco.MjModel) -> int:
    """Samples that the longest buffer of an actuator's native `delay` holds, 0 where there is none."""
    return int(np.max(model.actuator_history[:, 0], initial=0))


def delayed(model: mujoco.MjModel, commands: Sequence[Array], dt: float) -> Array:
    """The command (..., nu) that MuJoCo's native delays let through of `commands`, the latest last."""
    latest = out = commands[-1]
    for i in np.flatnonzero((model.actuator_history[:, 0] > 0) & (model.actuator_delay > 0)):
        if out is latest:
            out = latest.copy()
        steps = float(model.actuator_delay[i]) / dt
        older = int(np.ceil(steps - 1e-9))
        share = older - steps if model.actuator_history[i, 1] else 0.0  # of the younger sample; else held
        old, young = (commands[max(len(commands) - 1 - age, 0)][..., i] for age in (older, older - 1))
        out[..., i] = old + share * (young - old)
    return out


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
