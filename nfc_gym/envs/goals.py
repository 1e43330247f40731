"""Goal-conditioned environments: the interface of gymnasium-robotics' `GoalEnv`, for learners that relabel goals."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nfc_gym.envs.robot import goal_reward
from nfc_gym.envs.single import RobotEnv
from nfc_gym.envs.vector import RobotVectorEnv


class Goals:
    """What `GoalEnv` adds. Goals may have any leading batch shape (...), `info` then being a sequence of dicts."""

    def compute_reward(self, achieved_goal: NDArray, desired_goal: NDArray, info: Any) -> NDArray[np.float64]:
        """Reward (...) of having achieved one goal where another was desired; `info` is not needed.

        Args:
          achieved_goal, desired_goal: (..., place_size) m.
          info: of the step.
        """
        robot = self.robot
        return goal_reward(achieved_goal, desired_goal, robot.arrived, robot.goal_conditioned)

    def compute_terminated(self, achieved_goal: NDArray, desired_goal: NDArray, info: Any) -> NDArray[np.bool_]:
        """Whether the episode ended early (...): goals have no part in that."""
        return _fact(info, "failed")

    def compute_truncated(self, achieved_goal: NDArray, desired_goal: NDArray, info: Any) -> NDArray[np.bool_]:
        """Never (...): the time limit is a wrapper's."""
        return _fact(info, "failed") & False


def _fact(info: Any, key: str) -> Any:
    """An entry of one `info`, or of a sequence of them."""
    if isinstance(info, Mapping):
        return np.asarray(info[key])[()]
    if isinstance(info, Sequence | np.ndarray):
        return np.array([each[key] for each in info])
    raise TypeError(f"info is {type(info).__name__}, want the dict of a step or a sequence of such")


# Gymnasium's classes are named again: see `RobotVectorEnv`.
class GoalRobotEnv(Goals, RobotEnv, gymnasium.Env):
    """A `RobotEnv` whose observation holds `observation`, `achieved_goal`, `desired_goal` (and the context)."""


class GoalRobotVectorEnv(Goals, RobotVectorEnv, gymnasium.vector.VectorEnv):  # type: ignore[override]
    """A `RobotVectorEnv` whose observation holds `observation`, `achieved_goal`, `desired_goal` (and the context)."""
