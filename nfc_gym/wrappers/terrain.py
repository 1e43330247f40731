"""`ResidualTerrain`: delta_e = truth - perceived. The simulator gets e + delta_e; the policy still sees e."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.terrain.lay import GRID
from nfc_gym.wrappers.base import EnvWrapper, VectorEnvWrapper
from nfc_gym.wrappers.batched import batch_simulation_of
from nfc_gym.wrappers.ground import Ground, raised
from nfc_gym.wrappers.simulation import simulation_of
from nfc_gym.wrappers.source import Draws, Source

Array = NDArray[np.float64]


class ResidualTerrain(EnvWrapper):
    """Draws a residual terrain at each reset; steps cost nothing.

    Args:
      env: an environment on a heightfield: a Rough one, or any MuJoCo environment whose model has one.
      source: where an episode's delta_e comes from: a posterior, an array (rows, columns) or (n, rows, columns) in m, a
        path. Of the heightfield's shape it lies in the world, cell by cell. In the robot's grid (128, 128), in which a
        neural posterior draws it and `elevation` shows the ground, it is laid where the robot starts, as it heads
        there, fading to zero over its outermost metre (`terrain.lay`); what would lead out of the heights that the
        environment can hold is cut.

    A `terrain_residual` among the options of `reset` is added to it.

    Raises:
      InputError: the environment has no heightfield, or delta_e has the shape of neither.
    """

    def __init__(self, env: gym.Env, source: Source) -> None:
        super().__init__(env, source=source)
        sim = simulation_of(env, "ResidualTerrain")
        self.ground = Ground(env, sim, "ResidualTerrain")
        self.draws = Draws(source, "delta_e", "ResidualTerrain")
        self.ground.require(self.draws.shape, "ResidualTerrain")
        self._delta = np.zeros(self.draws.shape)

    @property
    def delta_e(self) -> Array:
        """(rows, columns) residual of the running episode as the source has it, m."""
        return self._delta.copy()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Draw the residual, then reset onto the ground with it."""
        with self.refusable(self.ground.kept(self._delta)):
            delta = self.draws.draw(1, self.stream(seed))[0]
            result = self.env.reset(seed=seed, options=self.ground.options(delta, options, seed))
            self._delta = delta
            return result


class VectorResidualTerrain(VectorEnvWrapper):
    """`ResidualTerrain` around a vector environment on `mujoco.batch`; arguments as there.

    Its simulations choose from a pool of maps. Each map of the pool gets a residual of its own at every `reset` without
    a `reset_mask`, for which the batch is built anew (tens of ms for 1000 simulations); with a single sample, only at
    the first. Autoresets, and resets of those whose episodes ended, choose among the maps as before.

    A source in the robot's grid gives every simulation a map of its own at such a reset, the one of the pool that it
    draws with the residual laid around its start; `terrain_id` then is the simulation's own number (a megabyte each).
    A batch cannot change its ground: later episodes of a simulation begin on the same map, within the square of starts
    around where the residual lies, and heading anywhere.
    """

    def __init__(self, env: VectorEnv, source: Source) -> None:
        super().__init__(env, source=source)
        sim = batch_simulation_of(env, "ResidualTerrain")
        maps = getattr(env.unwrapped, "maps", ())
        if not maps:
            raise InputError(f"ResidualTerrain needs rough ground: {type(env.unwrapped).__name__} stands on a plane")
        self.sim, self.perceived = sim, tuple(maps)
        self.draws = Draws(source, "delta_e", "ResidualTerrain")
        shape = maps[0].heights.shape
        shapes = {shape: "the environment's heightfields"}
        if hasattr(env.unwrapped, "coming"):
            shapes.setdefault(GRID, "the robot's grid")
        self.draws.expect(*shapes, meaning=" or ".join(shapes.values()))
        self.around = self.draws.shape != shape
        self._delta: Array | None = None
        sampler = self.draws.sampler
        one = isinstance(sampler, Fidelity) and (not sampler.batched or len(sampler) == 1)
        self._constant = one and not self.around
        sim.on_reset.add(self._own)

    @property
    def delta_e(self) -> Array:
        """(maps, rows, columns) residual of each map of the pool, m; in the robot's grid that of each simulation."""
        if self._delta is None:
            raise InputError("VectorResidualTerrain: residuals are drawn at the first reset")
        return self._delta.copy()

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Draw residuals where all environments begin anew, then reset."""
        if self.around and (options or {}).get("terrain_id") is not None:
            raise InputError(
                "VectorResidualTerrain: every simulation stands on a map of its own, with the residual laid around its "
                "start; leave the option terrain_id out"
            )
        self.vet(seed, options)
        # A mask names those whose episodes ended, also where these happen to be all.
        mask, first = (options or {}).get("reset_mask"), self._delta is None
        if first and mask is not None and not np.all(mask):
            raise InputError("VectorResidualTerrain: the first reset must be of all environments, got a reset_mask")
        with self.refusable():
            rng = self.stream(seed)
            if first or (mask is None and not self._constant):
                self._build(rng, seed)
            return self.env.reset(seed=seed, options=options)

    def _build(self, rng: np.random.Generator, seed: Any) -> None:
        """Draw residuals, and give the batch the maps with them."""
        base, seen = self.env.unwrapped, self.perceived
        delta = residual = self.draws.draw(self.num_envs if self.around else len(seen), rng)
        if self.around:
            which, poses = base.coming(seed=seed, maps=seen)
            seen = tuple(seen[k] for k in which)
            limits = base.height_limits
            residual = [raised(m, d, pose, limits) for m, d, pose in zip(seen, delta, poses, strict=True)]
        base.set_terrains([(m.heights + r).astype(np.float32) for m, r in zip(seen, residual, strict=True)], seen)
        self._delta = delta

    def _own(self, ids: NDArray[np.intp]) -> dict[str, Any]:
        """The map of each simulation, where it has one to itself."""
        return {"terrain_id": ids} if self.around and self._delta is not None else {}
