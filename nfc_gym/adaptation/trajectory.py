"""What a robot does in the world, and the data set of all of it."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import gymnasium
import numpy as np
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.files import replacing
from nfc_gym.inference.posterior import Window
from nfc_gym.inference.rates import Threshold, threshold_at
from nfc_gym.terrain.egocentric import SIZE
from nfc_gym.wrappers.anomaly import scored

Array = NDArray[np.float64]
LOOK = 25  # control steps from one map that is kept to the next: 1 m at 2 m/s, of 6.4 m to each side
_LATER = ("maps", "looks", "alarm_map")


@dataclass(frozen=True)
class Trajectory:
    """One episode in the world.

    Attributes:
      states: (T+1, s) `proprio` as observed.
      actions: (T, a) as commanded.
      rewards: (T,).
      scores: (T,) of the anomaly detector.
      threshold: from which score on a transition is anomalous.
      estimate: (T+1, nq + nv + na) positions, velocities and actuator states by a state estimate, or (T+1, 0) where
        there is none.
      elevation: (128, 128) perceived at the last step, or (0, 0).
      reached: whether the goal was reached at any time.
      ended: whether the episode ended early.
      maps: (k, 128, 128) perceived along the way, or (0, 128, 128).
      looks: (k,) rows of `states` at which they were.
      alarm_map: (128, 128) perceived after the transition that was most unusual, or (0, 0).
    """

    states: Array
    actions: Array
    rewards: Array
    scores: Array
    threshold: float
    estimate: Array
    elevation: Array
    reached: bool = False
    ended: bool = False
    maps: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, SIZE, SIZE), np.float32))
    looks: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    alarm_map: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def anomalous(self) -> bool:
        """Whether any transition was."""
        return bool((self.scores >= self.threshold).any())

    @property
    def total(self) -> float:
        """Its return."""
        return float(self.rewards.sum())

    def until_alarm(self) -> "Trajectory":
        """Up to the transition that was most unusual: what a posterior that sees one window is to look at."""
        stop = int(np.argmax(self.scores)) + 1
        seen = self.looks <= stop
        elevation = self.elevation
        if self.alarm_map.size:
            elevation = self.alarm_map.astype(float)
        elif seen.any():  # a file of before that map was kept: the last on the way
            elevation = self.maps[seen][-1].astype(float)
        return Trajectory(
            self.states[: stop + 1], self.actions[:stop], self.rewards[:stop], self.scores[:stop], self.threshold,
            self.estimate[: stop + 1], elevation, self.reached, self.ended, self.maps[seen], self.looks[seen],
            self.alarm_map,
        )  # fmt: skip

    def window(self) -> Window:
        """As posteriors want it."""
        return Window(self.states, self.actions, self.elevation if self.elevation.size else None)

    def save(self, path: Path) -> None:
        """Write an `.npz`."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part, open(part, "wb") as handle:
            arrays: dict[str, Any] = {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}
            np.savez_compressed(handle, **arrays)

    @classmethod
    def load(cls, path: Path) -> "Trajectory":
        """Read one; nothing in the file is unpickled."""
        try:
            with np.load(path, allow_pickle=False) as archive:
                # Those of before 0.1.0 was out have no maps of the way.
                wanted = [f.name for f in fields(cls) if f.name in archive or f.name not in _LATER]
                parts: dict[str, Any] = {name: archive[name] for name in wanted}
        except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile) as e:
            raise InputError(f"{path}: truncated, or no trajectory ({e})") from None
        scalars = {"threshold": float, "reached": bool, "ended": bool}
        return cls(**{k: scalars[k](v) if k in scalars else v for k, v in parts.items()})


class Dataset:
    """All trajectories so far, in memory and, with a folder, on disk.

    Args:
      folder: where each is a file of its own, `trajectory_00000.npz`.
      count: how many of those that are there already belong to the run; others are written over.
    """

    def __init__(self, folder: Path | None = None, count: int = 0) -> None:
        self.folder = folder
        self._kept = [Trajectory.load(self._path(k)) for k in range(count)]

    def _path(self, k: int) -> Path:
        assert self.folder is not None
        return self.folder / f"trajectory_{k:05}.npz"

    def add(self, trajectory: Trajectory) -> None:
        """Keep one more."""
        if self.folder is not None:
            trajectory.save(self._path(len(self._kept)))
        self._kept.append(trajectory)

    def __len__(self) -> int:
        return len(self._kept)

    def __iter__(self) -> Iterator[Trajectory]:
        return iter(self._kept)

    def __getitem__(self, k: int) -> Trajectory:
        return self._kept[k]


def threshold_of(nominal: Iterable[Trajectory], rate: float) -> Threshold:
    """The threshold at which a share `rate` of nominal trajectories has an anomaly anywhere.

    A rate of windows is another: an episode has many of them, and one alarm makes it anomalous.

    Raises:
      InputError: too few trajectories for the rate.
    """
    return threshold_at([float(t.scores.max()) for t in nominal], rate, "trajectories")


def limited(world: Any) -> bool:
    """Whether it is known that a world's episodes end in time: its spec says so, or a `TimeLimit` around it."""
    spec = getattr(world, "spec", None)
    if spec is not None and (spec.max_episode_steps or 0) > 0:
        return True
    while isinstance(world, gymnasium.Wrapper):
        if isinstance(world, TimeLimit):
            return True
        world = world.env
    return False


def execute(
    policy: Callable[[Any], Any], world: Any, detector: Any, threshold: float, seed: int, longest: int | None = None
) -> Trajectory:
    """One episode.

    Args:
      policy: observation -> action.
      world: a single environment of this package with anything around it; its observation has `proprio`.
      detector: scores transitions (`nfc_gym.wrappers.Detector`).
      threshold: from which score on one is anomalous.
      seed: of the episode.
      longest: control steps after which it is cut; None leaves that to the world.

    An episode that ends by itself, its goal not reached, before the detector has scored anything is anomalous: who
    falls at once was never found to be normal.

    Raises:
      InputError: the observation lacks `proprio`; a score or a reward is no number; nothing says when to end.
    """
    if longest is None and getattr(world, "spec", None) is not None and not limited(world):
        raise InputError(
            "adapt: the world has no time limit, its episode may never end: make it with max_episode_steps, or give "
            "`longest`, control steps after which it is cut"
        )
    observation, _ = world.reset(seed=seed)
    detector.reset()
    states, estimate = [_proprio(observation)], [_estimate(world)]
    actions, rewards, scores = [], [], []
    maps, looks, alarm_map = [], [], np.zeros((0, 0), np.float32)
    over = reached = ended = False
    most = -np.inf
    while not over:
        if "elevation" in observation and len(actions) % LOOK == 0:
            maps.append(np.array(observation["elevation"], np.float32))
            looks.append(len(actions))
        action = np.asarray(policy(observation), np.float64)
        after, reward, ended, truncated, info = world.step(action)
        scores.append(float(scored(world, detector, observation, action, after)))
        if "elevation" in after and scores[-1] > most:
            most, alarm_map = scores[-1], np.array(after["elevation"], np.float32)
        rewards.append(_reward(reward, len(actions)))
        actions.append(action)
        states.append(_proprio(after))
        estimate.append(_estimate(world))
        reached |= bool(info.get("success", False))
        observation, over = after, bool(ended or truncated) or len(actions) == longest
    if ended and not reached and not np.any(scores):
        scores[-1] = threshold
    elevation = np.asarray(observation.get("elevation", np.zeros((0, 0))), float)
    return Trajectory(
        np.array(states), np.array(actions), np.array(rewards), np.array(scores), threshold, np.array(estimate),
        elevation, reached, bool(ended), np.array(maps, np.float32).reshape(-1, SIZE, SIZE), np.array(looks, np.intp),
        alarm_map,
    )  # fmt: skip


def _reward(reward: Any, step: int) -> float:
    """A step's; of one that is no number nothing could be learned, and no return be told."""
    given = np.asarray(reward)
    if given.shape or given.dtype.kind not in "fiub" or not np.isfinite(given):
        raise InputError(f"adapt: the world's reward at step {step} is {reward!r}, want a finite number")
    return float(given)


def _proprio(observation: Any) -> Array:
    if not isinstance(observation, dict) or "proprio" not in observation:
        raise InputError("adapt: the world's observation must hold 'proprio': make it with context=['psi'] or more")
    return np.array(observation["proprio"], float)


def _estimate(world: Any) -> Array:
    """Positions, velocities and actuator states, where the world has a simulation that knows them."""
    data = getattr(world.unwrapped, "data", None)
    return np.zeros(0) if data is None else np.concatenate([data.qpos, data.qvel, data.act])
