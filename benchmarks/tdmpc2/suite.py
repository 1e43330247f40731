"""Tasks of the DeepMind Control Suite as TD-MPC2's authors ran them, and what they measured."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from nfc_gym.core.errors import InputError

REPEAT = 2  # simulation steps that an action is held for, as the authors have it
EPISODE = 500  # control steps
# Returns of three seeds by simulation steps (control steps times REPEAT), from github.com/nicklashansen/tdmpc2: folder
# results/ at b67b21c (cartpole-swingup) and results/tdmpc2/ at add30b5 (the others). That steps count repeated actions
# is said in that repository's issue 45. The first row is before any learning.
PUBLISHED: Mapping[str, Mapping[int, tuple[float, float, float]]] = {
    "cartpole-swingup": {0: (1.5, 2.0, 4.8), 100_000: (860.5, 789.8, 867.9), 200_000: (859.1, 877.6, 879.0),
                         500_000: (866.0, 882.0, 880.2), 1_000_000: (864.7, 881.1, 881.9)},
    "pendulum-swingup": {0: (0.0, 0.0, 1.4), 100_000: (563.7, 852.2, 756.0), 200_000: (801.6, 795.0, 876.9),
                         500_000: (884.6, 824.2, 816.3), 1_000_000: (815.6, 774.8, 867.7)},
    "reacher-easy": {0: (51.5, 91.4, 140.8), 100_000: (977.9, 972.8, 859.9), 200_000: (969.3, 985.5, 973.9),
                     500_000: (985.4, 892.2, 880.7), 1_000_000: (978.4, 981.8, 987.8)},
}  # fmt: skip


class SuiteEnv(gymnasium.Env):
    """A task as a Gymnasium environment: all that is observed in one vector, actions in [-1, 1] held for REPEAT steps.

    Args:
      task: such as `cartpole-swingup`.

    Raises:
      InputError: no such task.
    """

    def __init__(self, task: str) -> None:
        self.task, self.env = task, loaded(task, 0)
        spec = self.env.action_spec()
        self._middle, self._half = (spec.maximum + spec.minimum) / 2, (spec.maximum - spec.minimum) / 2
        size = sum(int(np.prod(v.shape)) for v in self.env.observation_spec().values())
        self.observation_space = spaces.Dict({"observation": spaces.Box(-np.inf, np.inf, (size,), np.float32)})
        self.action_space = spaces.Box(-1.0, 1.0, spec.shape, np.float32)
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See `gymnasium.Env`."""
        super().reset(seed=seed)
        if seed is not None:
            self.env.task._random = np.random.RandomState(seed % 2**32)
        self.steps = 0
        return self._seen(self.env.reset()), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See `gymnasium.Env`; no task of those published ends early."""
        reward = 0.0
        for _ in range(REPEAT):
            found = self.env.step(self._middle + self._half * np.asarray(action, float))
            reward += float(found.reward)
        self.steps += 1
        return self._seen(found), reward, False, self.steps >= EPISODE, {}

    @staticmethod
    def _seen(found: Any) -> dict[str, Any]:
        parts = [np.ravel(v) for v in found.observation.values()]
        return {"observation": np.concatenate(parts).astype(np.float32)}


def suite_envs(task: str, n: int) -> SyncVectorEnv:
    """n of them, one after another, without autoreset."""
    return SyncVectorEnv([lambda: SuiteEnv(task) for _ in range(n)], autoreset_mode=AutoresetMode.DISABLED)


def loaded(task: str, seed: int) -> Any:
    """The suite's environment.

    dm_control 1.0.50 indexes fields of flexible bodies that MuJoCo 4 has dropped. No task of the suite has such bodies,
    so names that this MuJoCo lacks are taken off its list.

    Raises:
      InputError: no such task.
    """
    from dm_control import suite
    from dm_control.mujoco.wrapper.mjbindings import sizes

    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    for kind, held in (("mjmodel", model), ("mjdata", mujoco.MjData(model))):
        for name in [name for name in sizes.array_sizes[kind] if not hasattr(held, name)]:
            del sizes.array_sizes[kind][name]
    domain, _, name = task.replace("cup-", "ball_in_cup-").partition("-")
    if (domain, name.replace("-", "_")) not in suite.ALL_TASKS:
        known = ", ".join(sorted(f"{d}-{t}".replace("_", "-") for d, t in suite.BENCHMARKING))
        raise InputError(f"task {task!r}: the suite has {known}")
    return suite.load(domain, name.replace("-", "_"), task_kwargs={"random": seed, "time_limit": float("inf")})
