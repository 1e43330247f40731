"""Buffers of MuJoCo's native delays: they hold a number of samples, and so less time where the physics step is shorter.

A buffer that is too short for its delay is no error to MuJoCo: what is read is as late as its oldest sample. At half
the step a delay would be half as long, and what that does would count as the step's own error.
"""

from collections.abc import Iterator

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError

_FINEST = 0.25  # of its step, that a model is rolled out at: half of it, and half again for the noise of what is halved
_MORE = 2  # samples older than the delay: cubic interpolation reads one besides the one before
_HAIR = 1e-9


def set_step(spec: mujoco.MjSpec, step: float) -> None:
    """Another physics step in s, in place; buffers hold as much time as they did."""
    for element in _buffered(spec):
        element.nsample = int(np.ceil(element.nsample * spec.option.timestep / step - _HAIR))
    spec.option.timestep = step


def make_room(spec: mujoco.MjSpec) -> None:
    """Lengthen buffers, in place, for a compiled model whose step is shortened as roll-outs do; it moves as before."""
    step = spec.option.timestep
    for element in _buffered(spec):
        element.delay = min(element.delay, element.nsample * step)  # as late as it was, however short the buffer
        element.nsample = max(element.nsample, int(np.ceil(element.delay / (_FINEST * step) - _HAIR)) + _MORE)


def require_room(model: mujoco.MjModel, step: float) -> None:
    """Refuse a compiled model whose delays would be shorter at another physics step, s.

    Raises:
      InputError: naming the actuator or sensor, and what to do.
    """
    for short in too_short(model, step):
        raise InputError(
            f"{short}; compile the model after nfc_gym.measured.buffers.make_room, or give it a longer nsample"
        )


def too_short(model: mujoco.MjModel, step: float) -> Iterator[str]:
    """Which actuators and sensors are less late than they say at a physics step, s, in words."""
    for kind in ("actuator", "sensor"):
        count, delay = getattr(model, f"{kind}_history")[:, 0], getattr(model, f"{kind}_delay")
        every = model.sensor_interval[:, 0] if kind == "sensor" else np.zeros(model.nu)
        for i in np.flatnonzero((count > 0) & (count * np.maximum(step, every) < delay * (1 - _HAIR))):
            name = getattr(model, kind)(int(i)).name or str(i)
            yield f"{kind} {name}: {count[i]} samples hold no delay of {delay[i]:g} s at a step of {step:g} s"


def _buffered(spec: mujoco.MjSpec) -> Iterator:
    """Actuators and sensors whose delay is read from a sample of every step; others keep time by themselves."""
    for element in (*spec.actuators, *spec.sensors):
        period = float(element.interval[0]) if isinstance(element, mujoco.MjsSensor) else 0.0
        if element.nsample > 0 and element.delay > 0 and period <= spec.option.timestep:
            yield element
