"""Which rows of a vector environment's observations are an episode's first, in each mode of autoreset."""

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


class Rows:
    """Follows the episodes of a vector environment from outside."""

    def __init__(self, env: VectorEnv) -> None:
        self.n = env.num_envs
        self.mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        self.done: Mask = np.zeros(self.n, bool)

    def reset(self, options: Any) -> Mask:
        """Rows that a `reset` with these options begins anew."""
        mask = (options or {}).get("reset_mask")
        new = np.ones(self.n, bool) if mask is None else np.asarray(mask, bool)
        self.done = self.done & ~new
        return new

    def step(self, terminated: Mask, truncated: Mask) -> Mask:
        """Rows of the observation just returned that begin an episode."""
        done = np.asarray(terminated | truncated, bool)
        if self.mode is AutoresetMode.SAME_STEP:
            return done
        first = self.done if self.mode is AutoresetMode.NEXT_STEP else np.zeros(self.n, bool)
        self.done = done
        return first
