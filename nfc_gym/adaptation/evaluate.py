"""How good a policy is: whole episodes in a vector environment."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray


@dataclass(frozen=True)
class Score:
    """Of some episodes, one number each.

    Attributes:
      returns: (n,) sums of rewards.
      lengths: (n,) control steps.
      reached: (n,) whether the goal was reached at any time; None where a task has no goal.
    """

    returns: NDArray[np.float64]
    lengths: NDArray[np.intp]
    reached: NDArray[np.bool_] | None

    def summary(self) -> dict[str, float]:
        """Means; of the return the standard error too."""
        n = len(self.returns)
        found = {
            "return": float(self.returns.mean()), "return_error": float(self.returns.std(ddof=min(1, n - 1)) / n**0.5),
            "length": float(self.lengths.mean()), "episodes": float(n),
        }  # fmt: skip
        return found if self.reached is None else found | {"success": float(self.reached.mean())}


def evaluate(policy: Callable[[Any], Any], envs: VectorEnv, seed: int = 0, longest: int | None = None) -> Score:
    """One episode in each simulation.

    Args:
      policy: observations (n, ...) -> actions (n, k).
      envs: a vector environment without autoreset; environment i begins from seed + i.
      seed: see above.
      longest: control steps after which an episode is cut; None leaves that to the environment.
    """
    observation, _ = envs.reset(seed=seed)
    n = envs.num_envs
    going, returns, lengths = np.ones(n, bool), np.zeros(n), np.zeros(n, np.intp)
    reached = np.zeros(n, bool)
    goals = False
    while going.any():
        observation, reward, ended, truncated, info = envs.step(policy(observation))
        returns += reward * going
        lengths += going
        if "success" in info:
            goals = True
            reached |= np.asarray(info["success"], bool) & going
        over = ended | truncated | (lengths == longest)
        going &= ~over
        if over.any() and going.any():  # the rest is not counted, but every simulation must be one that may step
            observation, _ = envs.reset(options={"reset_mask": over})
    return Score(returns, lengths, reached if goals else None)
