"""Simulations that a world model learns from: TorchRL-style vector environments without autoreset."""

from collections import deque
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv

from nfc_gym.core.errors import InputError

from .planner import Planner
from .replay import Array, Replay, Windows
from .speed import Speed
from .world_model import Sizes, WorldModel

RECENT = 100  # episodes that means are over


def sizes_of(envs: VectorEnv) -> Sizes:
    """Of an environment that a world model can learn in.

    Raises:
      InputError: its observation or action is of another kind.
    """
    seen, action = envs.single_observation_space, envs.single_action_space
    inner = seen["observation"] if isinstance(seen, spaces.Dict) and "observation" in seen.spaces else None
    if not isinstance(inner, spaces.Box) or len(inner.shape) != 1:
        raise InputError(f"TD-MPC2 learns from a vector under 'observation' (see `VectorSight`), and there is {seen}")
    if not isinstance(action, spaces.Box) or len(action.shape) != 1:
        raise InputError(f"TD-MPC2 plans actions that are vectors in [-1, 1], and the environment takes {action}")
    if not (np.all(action.low == -1) and np.all(action.high == 1)):
        raise InputError(f"TD-MPC2 plans actions in [-1, 1], and the environment takes {action}: rescale them")
    if envs.metadata.get("autoreset_mode") is not AutoresetMode.DISABLED:
        raise InputError("TD-MPC2 resets simulations itself: make the environment with autoreset_mode='Disabled'")
    return Sizes(inner.shape[0], action.shape[0])


class Collector:
    """Acts in simulations and keeps what happens.

    Args:
      envs: see `sizes_of`.
      model: whose plans are followed.
      gamma: discount a control step.
      replay: what is kept.
      seed: of episodes and of random actions.
      speed: of the plans.

    Attributes:
      steps: control steps of all simulations together.
      episodes: that ended.
      recent: (return, length) of the last of them.
    """

    def __init__(
        self, envs: VectorEnv, model: WorldModel, gamma: float, replay: Replay, seed: int, speed: Speed | None = None
    ) -> None:
        self.envs, self.model, self.replay = envs, model, replay
        sizes, n = sizes_of(envs), envs.num_envs
        if sizes != model.sizes:
            raise InputError(f"the world model is of {model.sizes}, the environment of {sizes}")
        self.planner = Planner(model, model.settings, gamma, sizes.action, n, model.device, speed)
        self.windows = Windows(n, sizes, model.settings.horizon)
        self.rng = np.random.default_rng(seed)
        self.steps = self.episodes = 0
        self.recent: deque[tuple[float, int]] = deque(maxlen=RECENT)
        self.observation = self._seen(envs.reset(seed=seed)[0])
        self.fresh = np.ones(n, bool)
        self.sums, self.lengths = np.zeros(n), np.zeros(n, int)
        self.windows.begin(self.observation, self.fresh)

    def step(self, random: bool = False) -> None:
        """One control step of all of them, by plans with noise or at random."""
        n, k = len(self.fresh), self.model.sizes.action
        if random:
            action = self.rng.uniform(-1, 1, (n, k)).astype(np.float32)
        else:
            seen = torch.from_numpy(self.observation).to(self.model.device)
            fresh = torch.from_numpy(self.fresh).to(self.model.device)
            action = self.planner.plan(seen, fresh, explore=True).cpu().numpy()
        observation, reward, ended, truncated, _ = self.envs.step(action)
        self.observation = self._seen(observation)
        self.replay.add(self.windows.step(action, np.asarray(reward, np.float32), ended, self.observation))
        self.steps += n
        self.sums += reward
        self.lengths += 1
        self.fresh = np.asarray(ended | truncated, bool)
        if self.fresh.any():
            self._begin()

    def _begin(self) -> None:
        over = self.fresh
        self.episodes += int(over.sum())
        self.recent.extend(zip(self.sums[over].tolist(), self.lengths[over].tolist(), strict=True))
        self.sums[over], self.lengths[over] = 0.0, 0
        self.observation = self._seen(self.envs.reset(options={"reset_mask": over.copy()})[0])
        self.windows.begin(self.observation, over)

    def means(self) -> dict[str, float]:
        """Of the last episodes; nothing before the first ends."""
        if not self.recent:
            return {}
        returns, lengths = np.array(self.recent, float).T
        return {"return": float(returns.mean()), "length": float(lengths.mean())}

    @staticmethod
    def _seen(observation: Any) -> Array:
        return np.array(observation["observation"], np.float32)
