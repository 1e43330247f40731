"""Which rows of a vector environment's observations are an episode's first, in each mode of autoreset.

Of same-step autoreset the observation already is the next episode's, and the last one is in `info["final_obs"]`: what a
wrapper makes of observations it must make of these too.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


def mode_of(env: VectorEnv) -> AutoresetMode:
    """How a vector environment begins the next episodes; one that does not say is taken for Gymnasium's default."""
    return AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))


class Rows:
    """Follows the episodes of a vector environment from outside."""

    def __init__(self, env: VectorEnv) -> None:
        self.n = env.num_envs
        self.mode = mode_of(env)
        self.done: Mask = np.zeros(self.n, bool)

    def reset(self, options: Any) -> Mask:
        """Rows that a `reset` with these options begins anew."""
        mask = (options or {}).get("reset_mask")
        new = np.ones(self.n, bool) if mask is None else np.array(mask, bool)  # a copy: the caller may write to its own
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

    def ended(self, info: dict[str, Any]) -> Mask:
        """Rows (n,) of which `info` holds the last observation, the one returned being the next episode's."""
        return np.asarray(info.get("_final_obs", np.zeros(self.n, bool)), bool)


def with_last(info: dict[str, Any], change: Callable[[int, Any], Any]) -> dict[str, Any]:
    """`info` with each row's last observation, where there are some, as `change` (row, observation) makes it."""
    if "final_obs" not in info:
        return info
    last = info["final_obs"].copy()
    for row in np.flatnonzero(info["_final_obs"]):
        last[row] = change(int(row), last[row])
    return {**info, "final_obs": last}


def with_rows(observation: Any, rows: Mask, own: Sequence[Any]) -> Any:
    """Observations (n, ...), or a dict or tuple of such, with `own` in the place of some rows, one observation each."""
    if isinstance(observation, dict):
        return {k: with_rows(v, rows, [each[k] for each in own]) for k, v in observation.items()}
    if isinstance(observation, tuple):
        return tuple(with_rows(v, rows, [each[k] for each in own]) for k, v in enumerate(observation))
    out = np.array(observation)
    out[rows] = own
    return out
