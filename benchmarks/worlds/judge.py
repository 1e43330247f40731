"""Episodes of a policy in a world, and what they were like."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from nfc_gym.measured.hidden import Array

from .figures import gates_passed, jerk, way

Policy = Callable[
    [Any], NDArray
]  # observations of n simulations -> actions (n, k); `begin(n)`, where it has one, first
GATES = 16  # points of the figure of eight that are to be passed in order
WITHIN = 0.5  # m, of a gate: a rover's length
DT = 0.02  # s, control


@dataclass
class Episodes:
    """Episodes of one policy in one world; lists of one number an episode, NaN where there is none.

    Attributes:
      returns: sum of rewards.
      success: the goal was reached, or every gate of the figure of eight passed in order.
      ended: it ended early (fell, tipped over, collided, came apart).
      ratio: way driven, where it succeeded, over the straight line to the goal or the length of the figure.
      orientation_jerk, position_jerk: rad/s^3 and m/s^3, see `figures`.
      steps: control steps.
    """

    returns: list[float]
    success: list[float]
    ended: list[float]
    ratio: list[float]
    orientation_jerk: list[float]
    position_jerk: list[float]
    steps: list[int]

    def to_json(self) -> dict[str, list[Any]]:
        """Plain lists; NaN becomes None."""
        return {k: [None if v != v else v for v in values] for k, values in asdict(self).items()}

    @classmethod
    def of_json(cls, found: dict[str, list[Any]]) -> "Episodes":
        """The inverse."""
        return cls(**{k: [float("nan") if v is None else v for v in values] for k, values in found.items()})


def whole_state(base: Any) -> tuple[Array, Array]:
    """True positions (n, nq) and speeds (n, nv) of an unwrapped vector environment, whichever engine moves it."""
    return base.state() if hasattr(base, "state") else (base.batch.bind("qpos").copy(), base.batch.bind("qvel").copy())


def state_of(env: Any) -> tuple[Array, Array, Array]:
    """True pose (n, 7) and velocity (n, 6) of every base, and its goal's place (n, k) [m], NaN where there is none.

    As MuJoCo has them: linear velocity in the world, angular in the base's own frame.
    """
    base = env.unwrapped
    goals = base.places if base.robot.place_size else np.full((base.num_envs, 2), np.nan)
    qpos, qvel = whole_state(base)
    return qpos[:, :7], qvel[:, :6], goals


def judge(policy: Policy, env: VectorEnv, seed: int, lap: float | None = None) -> Episodes:
    """One episode in each simulation of an environment, with seeds `seed`, `seed` + 1, ...

    Args:
      policy: sees observations alone.
      env: autoresets at the step after an episode's last, or not at all.
      seed: of the first.
      lap: of a figure of eight [s]; None is a goal, or none.
    """
    n = env.num_envs
    begin = getattr(policy, "begin", None)
    if begin is not None:
        begin(n)
    observation, _ = env.reset(seed=seed)
    states = [state_of(env)]
    returns, live, steps = np.zeros(n), np.ones(n, bool), np.zeros(n, int)
    early, arrived = np.zeros(n, bool), np.full(n, -1)
    while live.any():
        observation, reward, ended, truncated, info = env.step(np.asarray(policy(observation), float))
        steps += live
        returns += np.where(live, reward, 0.0)
        states.append(state_of(env))
        early |= live & ended
        there = live & (arrived < 0) & np.asarray(info.get("success", np.zeros(n)), bool)
        arrived[there] = steps[there]
        over = ended | truncated
        live &= ~over
        if over.any() and live.any() and env.metadata["autoreset_mode"] is AutoresetMode.DISABLED:
            observation, _ = env.reset(options={"reset_mask": over})  # its episodes are not counted
    course = Course(*(np.array(part) for part in zip(*states, strict=True)), steps, arrived)
    rows = [course.row(i, lap) for i in range(n)]
    success, *columns = (list(c) for c in zip(*rows, strict=True))
    return Episodes(returns.tolist(), success, early.astype(float).tolist(), *columns, steps.tolist())


@dataclass
class Course:
    """What was recorded: (T + 1, n, ...) poses, speeds, goals' places; and (n,) steps, and step of arrival or -1."""

    poses: Array
    speeds: Array
    goals: Array
    steps: NDArray[np.integer]
    arrived: NDArray[np.integer]

    def row(self, i: int, lap: float | None) -> tuple[float, float, float, float]:
        """Success, ratio, orientation's and position's jerk of an episode."""
        last = int(self.steps[i])
        places, goals = (a[: last + 1, i, : self.goals.shape[2]] for a in (self.poses, self.goals))
        turning, moving = self.speeds[1 : last + 1, i, 3:6], self.speeds[1 : last + 1, i, :3]
        success, ratio = _lap(places, goals, lap) if lap else _arrival(places, goals[0], int(self.arrived[i]))
        return success, ratio, jerk(turning, DT), jerk(moving, DT)


def _arrival(places: Array, goal: Array, at: int) -> tuple[float, float]:
    """Success, and the way until then over the straight one."""
    straight = float(np.linalg.norm(goal - places[0]))
    return (0.0, float("nan")) if at < 0 else (1.0, way(places[: at + 1]) / straight)


def _lap(places: Array, goals: Array, lap: float) -> tuple[float, float]:
    """The same of a lap after a goal that moves: its gates, passed in order."""
    points = goals[: round(lap / DT) + 1]
    if len(points) <= round(lap / DT):
        return 0.0, float("nan")
    gates = points[np.linspace(0, len(points) - 1, GATES + 1).astype(int)[1:]]
    met, at = gates_passed(places, gates, WITHIN)
    return (1.0, way(places[: at + 1]) / way(points)) if met == len(gates) else (0.0, float("nan"))


class Uniform:
    """The random policy: actions uniform in [-1, 1]."""

    def __init__(self, size: int, seed: int) -> None:
        self.size, self.rng = size, np.random.default_rng(seed)
        self.n = 0

    def begin(self, n: int) -> None:
        """How many robots there are."""
        self.n = n

    def __call__(self, observation: Any) -> Array:
        """Whatever is observed."""
        return self.rng.uniform(-1, 1, (self.n, self.size))
