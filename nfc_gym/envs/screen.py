"""`Screen`: what an environment's render mode shows, made when it is first asked for."""

from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.envs.render import TRACK, Camera, Pictures, Window, camera_of


def warn_without_mode() -> None:
    """What Gymnasium's own environments say to `render` without a `render_mode`."""
    gymnasium.logger.warn(
        "render() shows nothing without a render_mode: give it when the environment is made, for instance "
        'gymnasium.make(..., render_mode="rgb_array")'
    )


class Screen:
    """Pictures or a window, by render mode.

    Args:
      mode: one of `modes`.
      modes: those that the environment has.
      settings: `width`, `height` and `camera` are used.

    Attributes:
      camera: may be changed between pictures.
    """

    def __init__(self, mode: str | None, modes: tuple[str | None, ...], settings: Any) -> None:
        if mode not in modes:
            raise InputError(f"render_mode is {mode!r}, want None or one of: {', '.join(filter(None, modes))}")
        self.camera: Camera = settings.camera
        self._mode, self._size = mode, (settings.width, settings.height)
        self._pictures: Pictures | None = None
        self._window: Window | None = None

    def require_camera(self, model: mujoco.MjModel) -> None:
        """Refuse a camera that the scene has not; of a robot that is not to be seen the default need not be there."""
        if self._mode is not None or self.camera != TRACK:
            camera_of(model, self.camera)

    def render(self, model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.uint8] | None:
        """A picture (height, width, 3), or None where a window was brought up to date, or there is no mode."""
        if self._mode == "rgb_array":
            if self._pictures is None:
                self._pictures = Pictures(model, *self._size)
            return self._pictures.render(model, _now(model, data), self.camera)
        if self._mode == "human":
            if self._window is None:
                self._window = Window(model, data, self.camera)
            self._window.render(model)
        if self._mode is None:
            warn_without_mode()
        return None

    def close(self) -> None:
        """Free the graphics context, close the window."""
        for shown in (self._pictures, self._window):
            if shown is not None:
                shown.close()
        self._pictures = self._window = None


def _now(model: mujoco.MjModel, data: mujoco.MjData) -> mujoco.MjData:
    """The simulation's state with all that is derived from it; after a step what is derived is a physics step old."""
    out = mujoco.MjData(model)
    mujoco.mj_copyState(model, data, out, mujoco.mjtState.mjSTATE_INTEGRATION.value)
    mujoco.mj_forward(model, out)
    return out
