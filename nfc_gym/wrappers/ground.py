"""The heightfield beneath an environment: read as a map of the world, and raised by residuals."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym import terrain
from nfc_gym.core.errors import InputError
from nfc_gym.physics.fields import names_of
from nfc_gym.physics.parameters import numbers
from nfc_gym.physics.state import yaw
from nfc_gym.terrain.lay import GRID
from nfc_gym.wrappers.simulation import SingleSimulation

Array = NDArray[np.float64]
# Model fields that `terrain.write` changes.
_WRITTEN = (
    "hfield_data", "hfield_size", "geom_pos", "geom_sameframe", "geom_size", "geom_aabb", "geom_rbound", "bvh_aabb",
)  # fmt: skip
_TURN = 1e-6  # rad within which ground counts as not turned
_FOOTPRINT = 1.0  # m around a start within which the ground must not rise into a robot


class Ground:
    """The heightfield beneath an environment, to which residuals are added.

    An environment with a `heightfield` of its own takes them by `reset(options={"terrain_residual": ...})`. Of any
    other the model's only heightfield is written, and the start in `init_qpos` rises with the ground around it.

    A residual in the robot's own grid (128, 128) is laid around where the episode starts: where `env.unwrapped.coming`
    says that the reset is about to put the robot, or at `init_qpos`. Where the heightfield itself has that shape, a
    residual is of the heightfield.

    Attributes:
      shape: (rows, columns).

    Raises:
      InputError: the environment has no heightfield, or several.
    """

    def __init__(self, env: gym.Env, sim: SingleSimulation, who: str) -> None:
        base = env.unwrapped
        self.sim, self.env = sim, base
        model = sim.model
        names = names_of(model, mujoco.mjtObj.mjOBJ_HFIELD, model.nhfield)
        if len(names) != 1 or not names[0]:
            told = getattr(env, "spec", None)
            which = told.id if told is not None else type(base).__name__
            found = f"has {len(names)}: {', '.join(map(repr, names))}" if names else "has none"
            raise InputError(
                f"{who} needs an environment on one named heightfield, and the model of {which} {found}"
                + ("; use its Rough variant" if hasattr(base, "psi_space") and not names else "")
            )
        self.name = names[0]
        self.shape = (int(model.hfield_nrow[0]), int(model.hfield_ncol[0]))
        self.own = hasattr(base, "heightfield")
        if not self.own:
            self.perceived = read_ground(model, who)
            geom = int(np.flatnonzero(model.geom_type == int(mujoco.mjtGeom.mjGEOM_HFIELD))[0])
            if model.geom_bodyid[geom] != 0:
                raise InputError(f"{who}: {_geom(model, geom)}, the heightfield, must belong to the world body")
            self.start = getattr(sim.owner, "init_qpos", np.zeros(0)).copy()
            self._given = {name: getattr(model, name).copy() for name in _WRITTEN}

    def require(self, shape: tuple[int, ...], who: str) -> None:
        """Refuse residuals of a shape that cannot be put here.

        Raises:
          InputError: it is neither the heightfield's nor the robot's grid, or nothing says where the robot starts.
        """
        if shape == self.shape:
            return
        if shape != GRID:
            raise InputError(
                f"{who}: the source's delta_e has shape {shape}; want {self.shape}, the environment's heightfield, or "
                f"{GRID}, the robot's grid"
            )
        if not (hasattr(self.env, "coming") if self.own else self._free()):
            raise InputError(
                f"{who}: delta_e {shape} lies around where the robot starts, and {type(self.env).__name__} does not "
                f"say where that is, as the init_qpos of a free body would; want delta_e {self.shape}"
            )

    def options(self, residual: Array, options: dict[str, Any] | None, seed: Any) -> dict[str, Any] | None:
        """Reset options under which the coming episode runs on e + residual, and the caller's own.

        Args:
          residual: (rows, columns), or (128, 128) in the robot's grid.
          options: of the reset.
          seed: of the reset.

        Raises:
          InputError: the caller's `terrain_residual` has another shape, or is no array of numbers.
        """
        if self.own:
            if residual.shape != self.shape:
                ground, pose = self.env.coming(seed=seed, options=options)
                residual = raised(ground, residual, pose, self.env.height_limits)
            own = None if options is None else options.get("terrain_residual")
            if own is not None:
                own = numbers(own, "terrain_residual")
                if own.shape != self.shape:
                    raise InputError(f"terrain_residual has shape {own.shape}, want {self.shape}")
                residual = residual + own
            return {**(options or {}), "terrain_residual": residual}
        self._write(residual)
        return options

    def _write(self, residual: Array) -> None:
        if residual.shape != self.shape:
            pose = np.array([*self.start[:2], yaw(self.start[3:7])])
            residual = raised(self.perceived, residual, pose)
        for name, value in self._given.items():
            getattr(self.sim.model, name)[...] = value
        heights = (self.perceived.heights + residual).astype(np.float32)
        truth = terrain.Heightfield(heights, self.perceived.resolution, self.perceived.origin)
        if residual.any():  # through metres and back the heights would change in their last bit
            terrain.write(self.sim.model, self.name, truth)
        self._lift(truth)

    def kept(self, residual: Array) -> Callable[[], None]:
        """What puts back the ground of the running episode, with its residual, after a reset that fails."""
        return (lambda: None) if self.own else lambda: self._write(residual)

    def _lift(self, truth: terrain.Heightfield) -> None:
        """Raise the start of a free body by what the ground within a robot's length of it has risen."""
        if not self._free():
            return
        side = np.arange(-_FOOTPRINT, _FOOTPRINT + 1e-9, truth.resolution / 2)
        around = self.start[:2] + np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
        rise = float(np.max(truth.height(around) - self.perceived.height(around)))
        self.sim.owner.init_qpos[2] = self.start[2] + max(rise, 0.0)

    def _free(self) -> bool:
        """Whether the start is that of a free body."""
        model = self.sim.model
        return bool(self.start.size) and int(model.jnt_type[0]) == int(mujoco.mjtJoint.mjJNT_FREE)


def raised(
    ground: terrain.Heightfield, patch: Array, pose: Array, limits: tuple[float, float] = (-np.inf, np.inf)
) -> Array:
    """The residual (rows, columns) [m] that a map (128, 128) around a robot is on some ground.

    Args:
      ground: to be raised.
      patch: in the robot's grid [m].
      pose: (3,) x and y [m] and heading [rad].
      limits: lowest and highest that the sum may be [m]; it is cut there.
    """
    laid = terrain.lay(patch, ground, pose[:2], pose[2])
    return np.clip(ground.heights + laid, *limits) - ground.heights


def read_ground(model: mujoco.MjModel, who: str) -> terrain.Heightfield:
    """The map that a model's only heightfield and its geom make in the world, or that of its level plane.

    Raises:
      InputError: the model has neither, or ground that no map can stand for: it is turned, or moves.
    """
    fixed = model.body_weldid[model.geom_bodyid] == 0  # to the world, on whatever bodies
    if model.nhfield == 0:
        every = model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)
        own = every & (model.geom_bodyid == 0)  # the world's own come before what is fixed to it
        planes = np.flatnonzero(own if own.any() else every & fixed)
        if len(planes) != 1:
            raise InputError(
                f"{who}: the model has no heightfield and {len(planes)} planes; want one of either as ground"
            )
        (_, _, z), axes = _pose(model, planes[0])
        if not np.allclose(axes[:, 2], (0, 0, 1), atol=_TURN):
            raise InputError(f"{who}: {_geom(model, planes[0])}, the model's plane, is not level")
        return terrain.Heightfield(np.full(terrain.SHAPE, z, np.float32))
    rows, cols = int(model.hfield_nrow[0]), int(model.hfield_ncol[0])
    geoms = np.flatnonzero((model.geom_type == int(mujoco.mjtGeom.mjGEOM_HFIELD)) & (model.geom_dataid == 0))
    if model.nhfield > 1 or len(geoms) != 1:
        raise InputError(
            f"{who}: the model has {model.nhfield} heightfields, {len(geoms)} geoms of the first; want one each"
        )
    (x, y, z), axes = _pose(model, geoms[0])
    if not fixed[geoms[0]] or not np.allclose(axes, np.eye(3), atol=_TURN):
        how = "is turned" if fixed[geoms[0]] else "is on a body that moves"
        raise InputError(f"{who}: {_geom(model, geoms[0])}, the model's heightfield, {how}; a map lies along x and y")
    half_x, half_y, span, _ = model.hfield_size[0]
    resolution = 2 * half_x / (cols - 1)
    if not np.isclose(resolution, 2 * half_y / (rows - 1)):
        raise InputError(f"{who}: the cells of the model's heightfield are not square")
    heights = z + span * np.asarray(model.hfield_data[: rows * cols], float).reshape(rows, cols)
    return terrain.Heightfield(heights.astype(np.float32), float(resolution), (float(x - half_x), float(y - half_y)))


def _pose(model: mujoco.MjModel, geom: int) -> tuple[Array, Array]:
    """Where a geom is in the world, (3,) m, and its axes as columns (3, 3), in the model's own configuration."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data.geom_xpos[geom].copy(), data.geom_xmat[geom].reshape(3, 3).copy()


def _geom(model: mujoco.MjModel, geom: int) -> str:
    return f"geom {model.geom(geom).name or int(geom)!r}"
