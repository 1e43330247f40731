"""A point on a rail, the smallest environment that TD-MPC2 learns in, and a world model of its size."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

torch = pytest.importorskip("torch", reason="TD-MPC2 learns with torch")
pytest.importorskip("torchrl", reason="TD-MPC2 writes its curves with TorchRL's loggers")


class Rail(gymnasium.Env):
    """A point on a rail, moved by its action; the nearer to the middle the better. Beyond `edge` the episode ends."""

    def __init__(self, length: int = 20, edge: float = 10.0, high: float = 1.0) -> None:
        self.observation_space = spaces.Dict({"observation": spaces.Box(-np.inf, np.inf, (2,), np.float32)})
        self.action_space = spaces.Box(-high, high, (1,), np.float32)
        self.length, self.edge = length, edge

    def _seen(self) -> dict[str, Any]:
        return {"observation": np.array([self.x, 1.0], np.float32)}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.t = float(self.np_random.uniform(-1, 1)), 0
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.x, self.t = self.x + 0.3 * float(action[0]), self.t + 1
        return self._seen(), 1 - abs(self.x), abs(self.x) > self.edge, self.t >= self.length, {}


def rails(n: int = 4, mode: AutoresetMode = AutoresetMode.DISABLED, **change: Any) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: Rail(**change) for _ in range(n)], autoreset_mode=mode)


def tiny(observation: int = 2, action: int = 1, **change: Any) -> Any:
    from dataclasses import replace

    from tdmpc2.settings import settings_of
    from tdmpc2.world_model import Sizes, WorldModel

    torch.manual_seed(0)
    settings = replace(settings_of("tiny", action, episodic=True), **change)
    return WorldModel(Sizes(observation, action), settings).eval()


def batch(n: int = 16) -> Any:
    from tensordict import TensorDict

    draw = torch.Generator().manual_seed(0)
    seen = torch.rand(n, 4, 2, generator=draw)
    return TensorDict(
        {
            "observation": seen,
            "action": torch.rand(n, 3, 1, generator=draw) * 2 - 1,
            "reward": seen[:, :-1, 0],
            "ended": torch.zeros(n, 3, dtype=torch.bool),
        },
        [n],
    )
