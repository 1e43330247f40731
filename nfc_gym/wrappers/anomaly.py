"""`MonitorAnomaly`: a detector that watches the transitions, and what it thinks of them in `info`."""

import os
from numbers import Real
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.posterior import load_source
from nfc_gym.wrappers.base import EnvWrapper, VectorEnvWrapper
from nfc_gym.wrappers.rows import Rows


@runtime_checkable
class Detector(Protocol):
    """Scores transitions; large is unusual. In a vector environment all arrays have a leading axis (n,)."""

    def reset(self, rows: NDArray[np.bool_] | None = None) -> None:
        """Forget the past: of everything, or of the rows (n,) whose episodes begin."""
        ...

    def update(self, obs: Any, action: Any, next_obs: Any) -> Any:
        """The score, a number or (n,), once (obs, action, next_obs) was seen."""
        ...


def opened(detector: Detector | str | os.PathLike[str], threshold: float | None) -> tuple[Detector, float]:
    """A detector and its threshold, the given one or its own.

    Raises:
      InputError: it is no detector, or nobody says from which score on it is an anomaly.
    """
    found: Any = load_source(detector) if isinstance(detector, str | os.PathLike) else detector
    if not isinstance(found, Detector):
        raise InputError(f"MonitorAnomaly: a detector has reset(rows) and update(obs, action, next_obs), got {found!r}")
    limit = getattr(found, "threshold", None) if threshold is None else threshold
    if not isinstance(limit, Real) or not np.isfinite(float(limit)):
        raise InputError(
            f"MonitorAnomaly: the threshold of the score must be a number, given or the detector's, got {limit!r}"
        )
    return found, float(limit)


def scored(env: Any, detector: Detector, obs: Any, action: Any, next_obs: Any) -> Any:
    """The detector's score of a transition, a number or (n,).

    Raises:
      InputError: it is NaN, which would pass for healthy; or the detector's own, which says so where goals are in the
        way.
    """
    try:
        score = np.asarray(detector.update(obs, action, next_obs), float)
        if np.isnan(score).any():
            where = f" of simulation {int(np.flatnonzero(np.isnan(score))[0])}" if score.ndim else ""
            raise InputError(f"MonitorAnomaly: the detector's score{where} is nan, want a number")
        return score
    except InputError as e:
        if isinstance(next_obs, dict) or not getattr(getattr(env.unwrapped, "robot", None), "goal_size", 0):
            raise
        raise InputError(
            f"{e}; with context=[] an observation is `proprio` and the goal in one: make the environment with "
            'context=["psi"]'
        ) from None


class MonitorAnomaly(EnvWrapper):
    """Adds `anomaly` (bool) and `anomaly_score` (float) to every `info`; at a reset False and 0.

    Args:
      env: any environment.
      detector: a `Detector`, or the path of a file that a registered loader opens as one.
      threshold: from which score on a transition counts as an anomaly; default the detector's own `threshold`.
    """

    def __init__(
        self, env: gym.Env, detector: Detector | str | os.PathLike[str], threshold: float | None = None
    ) -> None:
        super().__init__(env, detector=detector, threshold=threshold)
        self.detector, self.threshold = opened(detector, threshold)
        self._last: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the detector too."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.detector.reset()
        self._last = observation
        return observation, {**info, "anomaly": np.bool_(False), "anomaly_score": np.float64(0.0)}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and score the transition."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        score = np.float64(scored(self.env, self.detector, self._last, action, observation))
        self._last = observation
        info = {**info, "anomaly": np.bool_(score >= self.threshold), "anomaly_score": score}
        return observation, reward, terminated, truncated, info


class VectorMonitorAnomaly(VectorEnvWrapper):
    """The same around any vector environment: (n,) arrays, with the masks that Gymnasium puts beside them.

    Of a row whose episode begins with the observation returned there is no transition: False and 0.
    """

    def __init__(
        self, env: VectorEnv, detector: Detector | str | os.PathLike[str], threshold: float | None = None
    ) -> None:
        super().__init__(env, detector=detector, threshold=threshold)
        self.detector, self.threshold = opened(detector, threshold)
        self.rows = Rows(env)
        self._last: Any = None

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the detector of the same rows too."""
        observation, info = self.env.reset(seed=seed, options=options)
        new = self.rows.reset(options)
        self.detector.reset(None if new.all() else new)
        self._last = observation
        return observation, self._with(info, np.zeros(self.num_envs), np.ones(self.num_envs, bool))

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step, and score the transitions."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        score = np.array(scored(self.env, self.detector, self._last, actions, observation))
        if score.shape != (self.num_envs,):
            raise InputError(f"MonitorAnomaly: the detector's scores have shape {score.shape}, want ({self.num_envs},)")
        first = self.rows.step(terminated, truncated)
        if first.any():
            self.detector.reset(first)
            score[first] = 0
        self._last = observation
        return observation, reward, terminated, truncated, self._with(info, score, first)

    def _with(self, info: dict[str, Any], score: NDArray, first: NDArray[np.bool_]) -> dict[str, Any]:
        everyone = np.ones(self.num_envs, bool)
        mine = {"anomaly": (score >= self.threshold) & ~first, "anomaly_score": score}
        return {**info, **mine, **{f"_{k}": everyone for k in mine}}
