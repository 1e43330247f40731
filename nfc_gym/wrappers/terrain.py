"""`ResidualTerrain`: delta_e = truth - perceived. The simulator gets e + delta_e; the policy still sees e."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from nfc_gym import terrain
from nfc_gym.core.errors import InputError
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.physics.fields import names_of
from nfc_gym.physics.parameters import numbers
from nfc_gym.wrappers.base import EnvWrapper, VectorEnvWrapper
from nfc_gym.wrappers.batched import batch_simulation_of
from nfc_gym.wrappers.simulation import SingleSimulation, simulation_of
from nfc_gym.wrappers.source import Draws, Source

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

    def options(self, residual: Array, options: dict[str, Any] | None) -> dict[str, Any] | None:
        """Reset options under which the coming episode runs on e + residual (rows, columns), and the caller's own.

        Raises:
          InputError: the caller's `terrain_residual` has another shape, or is no array of numbers.
        """
        if self.own:
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
        owner, model = self.sim.owner, self.sim.model
        free = model.njnt > 0 and int(model.jnt_type[0]) == int(mujoco.mjtJoint.mjJNT_FREE)
        if not free or not self.start.size:
            return
        side = np.arange(-_FOOTPRINT, _FOOTPRINT + 1e-9, truth.resolution / 2)
        around = self.start[:2] + np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
        rise = float(np.max(truth.height(around) - self.perceived.height(around)))
        owner.init_qpos[2] = self.start[2] + max(rise, 0.0)


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


class ResidualTerrain(EnvWrapper):
    """Draws a residual terrain at each reset; steps cost nothing.

    Args:
      env: an environment on a heightfield: a Rough one, or any MuJoCo environment whose model has one.
      source: where an episode's delta_e comes from: a posterior, an array (rows, columns) or (n, rows, columns) in m, a
        path. It lies in the world, cell by cell on the environment's heightfield.

    A `terrain_residual` among the options of `reset` is added to it.

    Raises:
      InputError: the environment has no heightfield, or delta_e has another shape than it.
    """

    def __init__(self, env: gym.Env, source: Source) -> None:
        super().__init__(env, source=source)
        sim = simulation_of(env, "ResidualTerrain")
        self.ground = Ground(env, sim, "ResidualTerrain")
        self.draws = Draws(source, "delta_e", "ResidualTerrain")
        self.draws.expect(self.ground.shape, meaning="the environment's heightfield")
        self._delta = np.zeros(self.ground.shape)

    @property
    def delta_e(self) -> Array:
        """(rows, columns) residual of the running episode, m."""
        return self._delta.copy()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Draw the residual, then reset onto the ground with it."""
        with self.refusable(self.ground.kept(self._delta)):
            delta = self.draws.draw(1, self.stream(seed))[0]
            result = self.env.reset(seed=seed, options=self.ground.options(delta, options))
            self._delta = delta
            return result


class VectorResidualTerrain(VectorEnvWrapper):
    """`ResidualTerrain` around a vector environment on `mujoco.batch`; arguments as there.

    Its simulations choose from a pool of maps. Each map of the pool gets a residual of its own at every `reset` without
    a `reset_mask`, for which the batch is built anew (tens of ms for 1000 simulations); with a single sample, only at
    the first. Autoresets, and resets of those whose episodes ended, choose among the maps as before.
    """

    def __init__(self, env: VectorEnv, source: Source) -> None:
        super().__init__(env, source=source)
        sim = batch_simulation_of(env, "ResidualTerrain")
        maps = getattr(env.unwrapped, "maps", ())
        if not maps:
            raise InputError(f"ResidualTerrain needs rough ground: {type(env.unwrapped).__name__} stands on a plane")
        self.sim, self.perceived = sim, tuple(maps)
        self.draws = Draws(source, "delta_e", "ResidualTerrain")
        self.draws.expect(maps[0].heights.shape, meaning="the environment's heightfields")
        self._delta: Array | None = None
        sampler = self.draws.sampler
        self._constant = isinstance(sampler, Fidelity) and (not sampler.batched or len(sampler) == 1)

    @property
    def delta_e(self) -> Array:
        """(maps, rows, columns) residual of each map of the pool, m."""
        if self._delta is None:
            raise InputError("VectorResidualTerrain: residuals are drawn at the first reset")
        return self._delta.copy()

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Draw residuals where all environments begin anew, then reset."""
        self.vet(seed, options)
        # A mask names those whose episodes ended, also where these happen to be all.
        mask, first = (options or {}).get("reset_mask"), self._delta is None
        if first and mask is not None and not np.all(mask):
            raise InputError("VectorResidualTerrain: the first reset must be of all environments, got a reset_mask")
        with self.refusable():
            rng = self.stream(seed)
            if first or (mask is None and not self._constant):
                delta = self.draws.draw(len(self.perceived), rng)
                truth = [(m.heights + d).astype(np.float32) for m, d in zip(self.perceived, delta, strict=True)]
                self.env.unwrapped.set_terrains(truth, self.perceived)
                self._delta = delta
            return self.env.reset(seed=seed, options=options)
