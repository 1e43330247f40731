"""An environment for data sets, small enough to be worked out by hand."""

from typing import Any

import gymnasium as gym
import numpy as np


class Spring(gym.Env):
    """Mass and spring that count: the observation is position and velocity, and what the step number is."""

    observation_space = gym.spaces.Dict(
        {"state": gym.spaces.Box(-np.inf, np.inf, (2,)), "nested": gym.spaces.Tuple((gym.spaces.Box(-1e9, 1e9, (1,)),))}
    )
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self, frame_skip: int = 1) -> None:
        self.dt = 0.02 * frame_skip

    def _see(self) -> tuple[Any, dict[str, Any]]:
        state = np.array([np.cos(self.k * self.dt), -np.sin(self.k * self.dt)], np.float32)
        return {"state": state, "nested": (np.array([self.k], np.float32),)}, {"time": 0.5 + self.k * self.dt}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.k = 0
        return self._see()

    def step(self, action: Any) -> Any:
        self.k += 1
        observation, info = self._see()
        return observation, float(action[0]), False, False, info
