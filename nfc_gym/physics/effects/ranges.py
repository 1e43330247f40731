"""Ranges of an actuator in an `MjSpec`: of its commands (`ctrl`), of its force (`force`), of its activation (`act`)."""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_WHOLE = 1e-6  # of a step


def range_of(actuator: mujoco.MjsActuator, kind: str) -> tuple[float, float]:
    """(low, high) that MuJoCo clips to, infinite where it does not; unsaid limits are there where a range is given."""
    low, high = map(float, getattr(actuator, f"{kind}range"))
    said = int(getattr(actuator, f"{kind}limited"))
    limited = said == int(mujoco.mjtLimited.mjLIMITED_TRUE)
    limited = limited or (said == int(mujoco.mjtLimited.mjLIMITED_AUTO) and low < high)
    return (low, high) if limited else (-np.inf, np.inf)


def shift_range(actuator: mujoco.MjsActuator, kind: str, by: float) -> None:
    """Take `by` off both ends, where there is a range."""
    low, high = range_of(actuator, kind)
    if low > -np.inf:
        setattr(actuator, f"{kind}range", (low - by, high - by))


def stretch_range(actuator: mujoco.MjsActuator, kind: str, by: float) -> None:
    """Multiply both ends by `by`, above 0, where there is a range."""
    low, high = range_of(actuator, kind)
    if low > -np.inf:
        setattr(actuator, f"{kind}range", (low * by, high * by))


def mixes(spec: mujoco.MjSpec, actuator: mujoco.MjsActuator) -> bool:
    """Whether an actuator's delay mixes two commands, which MuJoCo does before it clips them."""
    steps = actuator.delay / spec.option.timestep
    return actuator.interp > 0 and abs(steps - round(steps)) > _WHOLE


def narrow_ranges(spec: mujoco.MjSpec, names: Sequence[str], kind: str, low: Array, high: Array) -> bool:
    """Clip actuators' ranges to bounds of their own, (n,) each, infinite where there are none.

    Returns:
      whether MJCF can say so; nothing is changed where a range would have no width, or MuJoCo does not heed it.
    """
    actuators = [spec.actuator(n) for n in names]
    ends = list(zip(low, high, strict=True))
    wanted = [np.clip(range_of(a, kind), *both) for a, both in zip(actuators, ends, strict=True)]
    heeded = kind != "ctrl" or not spec.option.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    if not all(a < b for a, b in wanted) or not (heeded or np.isinf(ends).all()):
        return False
    for actuator, both in zip(actuators, wanted, strict=True):
        if np.isfinite(both).any():
            setattr(actuator, f"{kind}range", both)
            setattr(actuator, f"{kind}limited", mujoco.mjtLimited.mjLIMITED_TRUE)
    return True
