"""`PerceiveTerrain`: the elevation map that a depth camera makes of the ground, in place of the true one."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from nfc_gym import terrain
from nfc_gym.core.errors import InputError
from nfc_gym.physics.state import yaw
from nfc_gym.terrain.egocentric import SIZE
from nfc_gym.wrappers.base import EnvWrapper, VectorEnvWrapper
from nfc_gym.wrappers.batched import batch_simulation_of
from nfc_gym.wrappers.ground import read_ground
from nfc_gym.wrappers.rows import Rows, with_last
from nfc_gym.wrappers.simulation import simulation_of

Camera = terrain.DepthCamera | Mapping[str, Any]
KEY = "elevation"


def camera_of(noise: Camera | None) -> terrain.DepthCamera:
    """A depth camera from its settings; an unknown one raises `InputError`."""
    if noise is None or isinstance(noise, terrain.DepthCamera):
        return noise or terrain.DepthCamera()
    known = [f.name for f in fields(terrain.DepthCamera)]
    if not isinstance(noise, Mapping):
        raise InputError(
            f"PerceiveTerrain: noise is {noise!r}; want a DepthCamera, or its settings: {', '.join(known)}"
        )
    unknown = [k for k in noise if k not in known]
    if unknown:
        raise InputError(f"PerceiveTerrain: a depth camera has no {unknown[0]!r}; it has: {', '.join(known)}")
    settings: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in noise.items()}
    return terrain.DepthCamera(**settings)


def with_map(space: gym.Space) -> spaces.Dict:
    """An observation space with the key `elevation`, put into a Dict beside `observation` where it is none.

    Raises:
      InputError: it has that key as something else than one map, which cannot be put in its place.
    """
    parts = dict(space.items()) if isinstance(space, spaces.Dict) else {"observation": space}
    shape = parts[KEY].shape if KEY in parts else (SIZE, SIZE)
    if shape != (SIZE, SIZE):
        raise InputError(
            f"PerceiveTerrain: {KEY!r} of the observation has shape {shape}, want {(SIZE, SIZE)}, one map; put "
            "PerceiveTerrain inside of what stacks or changes it"
        )
    return spaces.Dict({**parts, KEY: spaces.Box(-np.inf, np.inf, (SIZE, SIZE), np.float32)})


def base_joint(model: mujoco.MjModel, who: str) -> int:
    """Coordinate at which the first free joint's position begins; a model without one raises `InputError`."""
    free = np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE))
    if not len(free):
        raise InputError(f"PerceiveTerrain: the camera needs a floating base, and the model of {who} has no free joint")
    return int(model.jnt_qposadr[free[0]])


def _seen(observation: Any, elevation: NDArray[np.float32]) -> dict[str, Any]:
    parts = observation if isinstance(observation, dict) else {"observation": observation}
    return {**parts, KEY: elevation}


class PerceiveTerrain(EnvWrapper):
    """Gives the observation the key `elevation` as a depth camera on the base would make it.

    Args:
      env: a MuJoCo environment with a floating base. The ground that is seen is the environment's `perceived` terrain
        where it has one, else its model's heightfield or plane as they were at first. A plain observation becomes
        `{"observation": ..., "elevation": ...}`.
      noise: a `terrain.DepthCamera`, or its settings by name: mount, field of view, range, noise, drift. Its rate and
        window say how often an image is taken and how long it is remembered.
    """

    def __init__(self, env: gym.Env, noise: Camera | None = None) -> None:
        super().__init__(env, noise=noise)
        self.sim = simulation_of(env, "PerceiveTerrain")
        name = type(env.unwrapped).__name__
        self.at = base_joint(self.sim.nominal, name)
        self.map = terrain.PerceivedMap(camera_of(noise))
        own = hasattr(env.unwrapped, "perceived")
        self.ground = None if own else read_ground(self.sim.nominal, "PerceiveTerrain")
        self._time = -np.inf
        self.observation_space = with_map(env.observation_space)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(128, 128) which cells of the last map were really seen."""
        return self.map.valid

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Forget what was seen, and reset."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.map.reset(self.stream(seed))
        return self._look(observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step and look."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._look(observation, bool(terminated)), reward, terminated, truncated, info

    def _look(self, observation: Any, ends: bool = False) -> dict[str, Any]:
        data, at = self.env.unwrapped.data, self.at
        # A simulation that came apart ends its episode at rest, with its clock at 0: no time passes for the camera.
        self._time = max(data.time, self._time) if ends else data.time
        ground = self.ground if self.ground is not None else self.env.unwrapped.perceived
        quat = data.qpos[at + 3 : at + 7]
        return _seen(observation, self.map.update(ground, data.qpos[at : at + 3], quat, yaw(quat), self._time))


class VectorPerceiveTerrain(VectorEnvWrapper):
    """`PerceiveTerrain` around a vector environment on `mujoco.batch`; arguments as there.

    Each robot has a camera and a drift of its own.
    """

    def __init__(self, env: VectorEnv, noise: Camera | None = None) -> None:
        super().__init__(env, noise=noise)
        self.sim = batch_simulation_of(env, "PerceiveTerrain")
        self.rows = Rows(env)
        self.at = base_joint(self.sim.nominal, type(env.unwrapped).__name__)
        self.map = terrain.PerceivedMap(camera_of(noise), env.num_envs)
        self._time = np.full(env.num_envs, -np.inf)
        self._stepping, self._ends = False, None
        self.sim.on_reset.add(self._end)
        self.single_observation_space = with_map(env.single_observation_space)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(n, 128, 128) which cells of the last maps were really seen."""
        return self.map.valid

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Forget what the rows that are reset saw, and reset."""
        self.vet(seed, options)
        self.stream(seed)
        self._stepping = False
        observation, info = self.env.reset(seed=seed, options=options)
        self._forget(self.rows.reset(options))
        return _seen(observation, self._maps()), info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step and look."""
        self._stepping, self._ends = self.rows.mode is AutoresetMode.SAME_STEP, None
        observation, reward, terminated, truncated, info = self.env.step(actions)
        self._stepping = False
        first = self.rows.step(terminated, truncated)
        if first.any():
            self._forget(first)
        maps = self._ends
        if maps is None:
            maps = self._maps()
        else:
            ends = maps.copy()
            info = with_last(info, lambda row, last: _seen(last, ends[row]))
            maps[first] = self._maps(first)
        return _seen(observation, maps), reward, terminated, truncated, info

    def _end(self, ids: NDArray[np.intp]) -> None:
        """Rows of a step are about to begin another episode: what all see at its end, which soon cannot be seen."""
        if self._stepping:
            self._ends = self._maps()

    def _forget(self, rows: NDArray[np.bool_]) -> None:
        new = iter(self.stream(None).spawn(int(rows.sum())))
        self._time[rows] = -np.inf
        self.map.reset([next(new) if row else None for row in rows], rows)  # type: ignore[misc]

    def _maps(self, rows: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        """(k, 128, 128) what robots see now, all or those of some rows."""
        base, at = self.env.unwrapped, self.at
        self.sim.look_again()
        qpos = self.sim.qpos
        # See `PerceiveTerrain`; only a simulation that came apart has its clock put back.
        self._time = np.maximum(self.sim.bind("time"), self._time)
        quat = qpos[:, at + 3 : at + 7]
        return self.map.update(base.perceived, qpos[:, at : at + 3], quat, yaw(quat), self._time, rows)
