"""`MonitorAnomaly`: a detector that watches the transitions, and what it thinks of them in `info`."""

import copy
import os
from collections.abc import Callable
from numbers import Real
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.posterior import load_source
from nfc_gym.wrappers.base import EnvWrapper, VectorEnvWrapper
from nfc_gym.wrappers.rows import Rows, with_rows


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


def scored(
    env: Any, detector: Detector, obs: Any, action: Any, next_obs: Any, counts: NDArray[np.bool_] | None = None
) -> NDArray[np.float64]:
    """The detector's score of a transition, (), or of those of a vector environment, (n,).

    Args:
      env: in which it was; errors look at it.
      detector, obs, action, next_obs: see `Detector`.
      counts: (n,) rows of a vector environment in which it is a transition; the others score 0, whatever is said.

    Raises:
      InputError: it is no number, or NaN, which would pass for healthy; there are more or less of them than
        transitions; or the detector's own, which says so where goals are in the way.
    """
    score = _numbers(_updated(env, detector, obs, action, next_obs), () if counts is None else counts.shape)
    if counts is not None:
        score[~counts] = 0
    if np.isnan(score).any():
        where = f" of simulation {int(np.flatnonzero(np.isnan(score))[0])}" if score.ndim else ""
        raise InputError(f"MonitorAnomaly: the detector's score{where} is nan, want a number")
    return score


def _numbers(score: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    given = np.asarray(score)
    if given.dtype.kind not in "fiub" or (given.shape and not shape):
        raise InputError(f"MonitorAnomaly: the detector's score is {score!r}, want a number")
    if given.shape != shape:
        raise InputError(f"MonitorAnomaly: the detector's scores have shape {given.shape}, want {shape}")
    return given.astype(float)


def _updated(env: Any, detector: Detector, obs: Any, action: Any, next_obs: Any) -> Any:
    return _blaming_goals(env, isinstance(next_obs, dict), lambda: detector.update(obs, action, next_obs))


def _blaming_goals(env: Any, apart: bool, call: Callable[[], Any]) -> Any:
    """What a detector returns; its error says so where goals are in the way, in observations that are not `apart`."""
    try:
        return call()
    except InputError as e:
        if apart or not getattr(getattr(env.unwrapped, "robot", None), "goal_size", 0):
            raise
        raise InputError(
            f"{e}; with context=[] an observation is `proprio` and the goal in one: make the environment with "
            'context=["psi"]'
        ) from None


def require_fit(env: Any, detector: Detector) -> None:
    """Refuse a detector that says before the first transition that it cannot score those of an environment.

    Args:
      env: one, or a vector environment.
      detector: with `require(observation_space, action_space)` of one simulation, or without.

    Raises:
      InputError: the detector's own.
    """
    ask = getattr(detector, "require", None)
    if ask is not None:
        spaces = (getattr(env, f"single_{kind}_space", None) or getattr(env, f"{kind}_space")
                  for kind in ("observation", "action"))  # fmt: skip
        observations, actions = spaces
        if observations is None or actions is None:  # a wrapper does not say
            return
        _blaming_goals(env, isinstance(observations, gym.spaces.Dict), lambda: ask(observations, actions))


class MonitorAnomaly(EnvWrapper):
    """Adds `anomaly` (bool) and `anomaly_score` (float) to every `info`; at a reset False and 0.

    Args:
      env: any environment.
      detector: a `Detector`, or the path of a file that a registered loader opens as one; one with `require` is asked
        first whether it can score what this environment observes.
      threshold: from which score on a transition counts as an anomaly; default the detector's own `threshold`.
    """

    def __init__(
        self, env: gym.Env, detector: Detector | str | os.PathLike[str], threshold: float | None = None
    ) -> None:
        super().__init__(env, detector=detector, threshold=threshold)
        self.detector, self.threshold = opened(detector, threshold)
        require_fit(env, self.detector)
        self._last: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the detector too."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.detector.reset()
        self._last = observation
        return observation, {**info, "anomaly": np.array(False), "anomaly_score": np.float64(0.0)}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and score the transition."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        score = scored(self.env, self.detector, self._last, action, observation)[()]
        self._last = observation
        # An array of shape (): Gymnasium's vectors make a mask of bools of it, and one of objects of a scalar.
        info = {**info, "anomaly": np.asarray(score >= self.threshold), "anomaly_score": score}
        return observation, reward, terminated, truncated, info


class VectorMonitorAnomaly(VectorEnvWrapper):
    """`MonitorAnomaly` around any vector environment; arguments as there.

    What it tells are (n,) arrays, with the masks that Gymnasium puts beside them. Of a row whose episode begins
    with the observation returned there is no transition: False and 0. With same-step autoreset the last one of the
    episode before is scored by its `final_obs`, and told in `final_info`.
    """

    def __init__(
        self, env: VectorEnv, detector: Detector | str | os.PathLike[str], threshold: float | None = None
    ) -> None:
        super().__init__(env, detector=detector, threshold=threshold)
        self.detector, self.threshold = opened(detector, threshold)
        require_fit(env, self.detector)
        self.rows = Rows(env)
        self._last: Any = None

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the detector of the same rows too."""
        # A copy: Gymnasium's own take the mask out of what they are given.
        observation, info = self.env.reset(seed=seed, options=copy.copy(options))
        new = self.rows.reset(options)
        self.detector.reset(None if new.all() else new)
        self._last = observation
        return observation, self._with(info, np.zeros(self.num_envs), np.ones(self.num_envs, bool))

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step, and score the transitions."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        first, ended = self.rows.step(terminated, truncated), self.rows.ended(info)
        reached = with_rows(observation, ended, list(info["final_obs"][ended])) if ended.any() else observation
        score = scored(self.env, self.detector, self._last, actions, reached, ~first | ended)
        if ended.any():
            told = self._told(np.where(ended, score, 0.0), ended)
            info = {**info, "final_info": {**info.get("final_info", {}), **told}, "_final_info": ended}
        if first.any():
            self.detector.reset(first)
            score = np.where(first, 0.0, score)
        self._last = observation
        return observation, reward, terminated, truncated, self._with(info, score, first)

    def _with(self, info: dict[str, Any], score: NDArray, first: NDArray[np.bool_]) -> dict[str, Any]:
        told = self._told(score, np.ones(self.num_envs, bool))
        return {**info, **told, "anomaly": told["anomaly"] & ~first}

    def _told(self, score: NDArray, rows: NDArray[np.bool_]) -> dict[str, Any]:
        mine = {"anomaly": (score >= self.threshold) & rows, "anomaly_score": score}
        return {**mine, **{f"_{k}": rows for k in mine}}
