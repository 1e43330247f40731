"""Pictures and a window of a simulation, in which a heightfield that changed at run time is seen to have changed."""

import os
import sys
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.envs.forking import require_graphics
from nfc_gym.physics.parameters import numbers

Camera = str | Mapping[str, Any]
TRACK = "track"  # the camera of each robot's file


def camera_of(model: mujoco.MjModel, camera: Camera) -> mujoco.MjvCamera:
    """A camera of the model by name, or a free one.

    Args:
      model: the scene.
      camera: a name, or {"lookat": (x, y, z) m, "distance": m, "azimuth": degrees, "elevation": degrees}, or
        {"trackbody": name, ...} to follow a body; what is left out is MuJoCo's default.

    Raises:
      InputError: there is no such camera, no such setting of a free one, or one that is none of these.
    """
    view = mujoco.MjvCamera()
    if isinstance(camera, str):
        names = [model.camera(k).name for k in range(model.ncam)]
        if camera not in names:
            raise InputError(f"no camera is called {camera!r}; the scene has {', '.join(names) or 'none'}")
        view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, names.index(camera)
        return view
    known = ("lookat", "distance", "azimuth", "elevation", "trackbody")
    if not isinstance(camera, Mapping):
        raise InputError(f"camera is {camera!r}, want the name of one, or a free one's {', '.join(known)}")
    mujoco.mjv_defaultFreeCamera(model, view)
    for key, value in camera.items():
        if key not in known:
            raise InputError(f"a free camera has no {key!r}; it has {', '.join(known)}")
        if key == "trackbody":
            view.type, view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, _body(model, value)
        elif key == "lookat":
            view.lookat[:] = _finite(value, (3,), "camera's lookat is {!r}, want three finite numbers, (x, y, z) in m")
        else:
            setattr(view, key, float(_finite(value, (), f"camera's {key} is {{!r}}, want a finite number")))
    return view


def _body(model: mujoco.MjModel, name: Any) -> int:
    try:
        return model.body(name).id
    except (KeyError, IndexError, TypeError):
        names = ", ".join(filter(None, (model.body(k).name for k in range(model.nbody))))
        raise InputError(f"camera's trackbody is {name!r}, want the name of a body: {names}") from None


def _finite(value: Any, shape: tuple[int, ...], message: str) -> NDArray[np.float64]:
    try:
        given = numbers(value, "camera")
    except InputError:
        given = np.array(np.nan)
    if given.shape != shape or not np.isfinite(given).all():
        raise InputError(message.format(value))
    return given


class _Shown:
    """Which heights a graphics context holds: a change of `hfield_data` reaches it only by an upload."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.data = model.hfield_data.copy()

    def changed(self, model: mujoco.MjModel) -> list[int]:
        """Heightfields that differ from what is shown, which is then taken to be brought up to date."""
        if np.array_equal(self.data, model.hfield_data):
            return []
        out = []
        for k in range(model.nhfield):
            part = slice(model.hfield_adr[k], model.hfield_adr[k] + model.hfield_nrow[k] * model.hfield_ncol[k])
            if not np.array_equal(self.data[part], model.hfield_data[part]):
                out.append(k)
        self.data[:] = model.hfield_data
        return out


def _context(width: int, height: int) -> Any:
    """An off-screen context: MuJoCo's choice, but EGL on Linux without a display, where that choice would fail."""
    told = os.environ.get("MUJOCO_GL") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if told or not sys.platform.startswith("linux"):
        return mujoco.GLContext(width, height)
    from mujoco.egl import GLContext

    return GLContext(width, height)


class Pictures:
    """Renders off screen; `MUJOCO_GL` (`egl`, `osmesa`, `glfw`) chooses by what.

    Args:
      model: the scene.
      width, height: of the picture in pixels.

    Raises:
      InputError: a picture larger than the graphics library draws, or the process cannot draw (`require_graphics`).
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        require_graphics()
        self._size = (height, width, 3)
        self._gl = _context(width, height)
        self._gl.make_current()
        self._context = self._buffer(model, width, height)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=2000)
        self._option, self._perturb = mujoco.MjvOption(), mujoco.MjvPerturb()
        self._shown = _Shown(model)

    def _buffer(self, model: mujoco.MjModel, width: int, height: int) -> mujoco.MjrContext:
        """What is drawn into, as large as the picture; the model says how large."""
        sizes, before = model.vis.global_, (model.vis.global_.offwidth, model.vis.global_.offheight)
        sizes.offwidth, sizes.offheight = max(before[0], width), max(before[1], height)
        try:
            return mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150.value)
        except mujoco.FatalError as error:
            sizes.offwidth, sizes.offheight = before
            self._gl.free()
            if "framebuffer" not in str(error):
                raise
            raise InputError(
                f"width {width} and height {height}: no picture of that size can be drawn here ({error}); want "
                "a smaller one"
            ) from None

    def render(self, model: mujoco.MjModel, data: mujoco.MjData, camera: Camera) -> NDArray[np.uint8]:
        """(height, width, 3) picture of a simulation of the scene."""
        require_graphics()
        self._gl.make_current()
        for k in self._shown.changed(model):
            mujoco.mjr_uploadHField(model, self._context, k)
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        view = camera_of(model, camera)
        mujoco.mjv_updateScene(model, data, self._option, self._perturb, view, every, self._scene)
        area = mujoco.MjrRect(0, 0, self._size[1], self._size[0])
        mujoco.mjr_render(area, self._scene, self._context)
        picture = np.empty(self._size, np.uint8)
        mujoco.mjr_readPixels(picture, None, area, self._context)
        return np.ascontiguousarray(picture[::-1])

    def close(self) -> None:
        """Free the graphics context."""
        self._context.free()
        self._gl.free()


class Window:
    """MuJoCo's passive viewer on a simulation.

    Raises:
      InputError: there is no display to open it on.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, camera: Camera) -> None:
        if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            # GLFW would end the whole process.
            raise InputError(
                'render_mode="human" opens a window, and there is no display (neither DISPLAY nor WAYLAND_DISPLAY is '
                'set): use "rgb_array", or `nfc-gym play ID --out FILE.mp4` for a video'
            )
        import mujoco.viewer

        self._handle = mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
        self._shown = _Shown(model)
        view = camera_of(model, camera)
        with self._handle.lock():
            for key in ("type", "fixedcamid", "trackbodyid", "distance", "azimuth", "elevation"):
                setattr(self._handle.cam, key, getattr(view, key))
            self._handle.cam.lookat[:] = view.lookat

    def render(self, model: mujoco.MjModel) -> None:
        """Show the present state."""
        for k in self._shown.changed(model):
            self._handle.update_hfield(k)
        self._handle.sync()

    def close(self) -> None:
        """Close the window."""
        self._handle.close()
