"""Vector environments as TorchRL sees them: `GymWrapper` over one `mujoco.batch` of all simulations."""

from collections.abc import Callable, Generator, Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import VectorEnv, VectorWrapper
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import Composite, Unbounded
from torchrl.envs import GymWrapper, default_info_dict_reader

from nfc_gym.adaptation.sight import VectorSight
from nfc_gym.simulate.machine import full_id
from nfc_gym.wrappers import VectorRandomizePsi

Wrap = Callable[[VectorEnv], VectorEnv]


class VectorStaggered(VectorWrapper):
    """Ends each simulation's first episode at a time of its own, so that later ones do not all end together.

    Args:
      env: without autoreset.
      longest: control steps of an episode.
      seed: of the draws.
    """

    def __init__(self, env: VectorEnv, longest: int, seed: int) -> None:
        super().__init__(env)
        self._longest, self._rng = longest, np.random.default_rng(seed)
        self._left = np.zeros(env.num_envs, int)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset; one without a mask draws new ends, one with it is what follows an end, though it be of all."""
        mask = (options or {}).get("reset_mask")
        if mask is None:
            self._left = self._rng.integers(1, self._longest + 1, self.num_envs)
        else:
            self._left[np.asarray(mask)] = 0
        return self.env.reset(seed=seed, options=options)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        self._left -= 1
        return observation, reward, terminated, truncated | (self._left == 0), info


def vector_env(name: str, n: int, *, threads: int = 0, episode: int | None = None, **settings: Any) -> VectorEnv:
    """n simulations of one of this package's environments, made for `VectorSight`.

    Args:
      name: id, with or without `nfc_gym/` before and `-v0` behind.
      n: simulations.
      threads: of the physics; 0 takes every core.
      episode: control steps; None is the environment's own.
      settings: of the environment.

    Raises:
      InputError: no such environment.
    """
    full = full_id(name)
    more: dict[str, Any] = {} if episode is None else {"max_episode_steps": episode}
    return gymnasium.make_vec(
        full, num_envs=n, context=["psi"], autoreset_mode="Disabled", nthread=threads, **more, **settings
    )


def robot_of(environment: str) -> str:
    """`nfc_gym/JackalFlat-v0` -> `jackal`."""
    return environment.removeprefix("nfc_gym/").split("Flat")[0].split("Rough")[0].lower()


def training_env(
    name: str, n: int, *, threads: int, seed: int, spread: float, episode: int, settings: Mapping[str, Any],
    staggered: bool = True,
) -> VectorSight:  # fmt: skip
    """Simulations to train in: psi drawn anew each episode, terrain from the pool, first ends staggered.

    Args:
      name, n, threads, episode: as `vector_env`.
      seed: of ends.
      spread: psi is uniform over this share of the prior around nominal; 0 is nominal always.
      settings: of the environment.
      staggered: first episodes end at different times; to judge a policy takes whole ones.
    """
    envs: VectorEnv = vector_env(name, n, threads=threads, episode=episode, **settings)
    if spread:
        envs = VectorRandomizePsi(envs, spread)
    return VectorSight(VectorStaggered(envs, episode, seed) if staggered else envs)


def torchrl_env(envs: VectorEnv) -> GymWrapper:
    """A vector environment as TorchRL's; `success` of `info` comes along where there is one."""
    wrapped = GymWrapper(envs)
    if envs.unwrapped.robot.place_size:
        shape = torch.Size([envs.num_envs])
        spec = Composite({"success": Unbounded(shape, dtype=torch.bool)}, shape=shape)
        wrapped.set_info_dict_reader(default_info_dict_reader(["success"], spec=spec))
    return wrapped


def batches(env: GymWrapper, actor: Any, horizon: int, device: torch.device) -> Generator[TensorDictBase, None, None]:
    """Batches (n, horizon) of steps that an actor takes, on a device, without end."""
    yield from Collector(
        env, actor, frames_per_batch=env.batch_size[0] * horizon, total_frames=-1, policy_device=device,
        storing_device=device, env_device="cpu", track_traj_ids=False, trust_policy=True,
        auto_register_policy_transforms=False,
    )  # fmt: skip
