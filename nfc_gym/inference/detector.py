"""From a score of windows to a detector of transitions, as the wrapper `MonitorAnomaly` has it."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import require_whole
from nfc_gym.inference.rates import Threshold, threshold_at

Array = NDArray[np.float64]


class WindowScore(Protocol):
    """Something that scores windows of one robot; large is unusual.

    Attributes:
      horizon: H, control steps of a window.
      states, actions: s and a, sizes of an observation `proprio` and of an action.
    """

    horizon: int
    states: int
    actions: int

    def score(self, states: Array, actions: Array) -> Array:
        """(n,) of windows: states (n, H+1, s), actions (n, H, a)."""
        ...


def checked(scorer: WindowScore, states: Any, actions: Any) -> tuple[Array, Array]:
    """Windows as a scorer wants them; longer ones count from their end.

    Args:
      scorer: whose sizes they must have.
      states: (n, H+1, s), or longer.
      actions: (n, H, a), as long as the states less one.

    Raises:
      InputError: windows shorter than H, of other widths, or not finite.
    """
    states, actions = np.asarray(states, float), np.asarray(actions, float)
    for name, x, width in (("states", states, scorer.states), ("actions", actions, scorer.actions)):
        if x.ndim != 3 or x.shape[2] != width:
            raise InputError(f"windows: {name} must have shape (n, time, {width}), got {x.shape}: of another robot?")
    if len(states) != len(actions) or states.shape[1] != actions.shape[1] + 1:
        raise InputError(f"windows: H + 1 states go with H actions, got shapes {states.shape} and {actions.shape}")
    if actions.shape[1] < scorer.horizon:
        raise InputError(f"windows: {actions.shape[1]} steps; this detector needs {scorer.horizon}")
    for name, x in (("states", states), ("actions", actions)):
        if not np.isfinite(x).all():
            raise InputError(f"windows: {name} holds {x[~np.isfinite(x)][0]:g}; every entry must be finite")
    return states[:, -scorer.horizon - 1 :], actions[:, actions.shape[1] - scorer.horizon :]


class WindowDetector:
    """Keeps the last H transitions of each episode, and scores them.

    Until H transitions are there the score is 0, or minus infinity where the threshold is not above 0, as that of log
    odds may be: a window that is not there alarms nobody. With `every` above 1 windows are scored each so many
    transitions and the score stands in between: what costs a replay need not be paid at 50 Hz. The threshold's
    false-positive rate is that of a scored window; successive windows overlap and alarm together.

    Args:
      scorer: of windows.
      threshold: see `calibrated`; None leaves it to `MonitorAnomaly`.
      every: transitions between two scores.

    Attributes:
      threshold: from which score on a window is an anomaly, or None.
      calibration: what it was chosen from, or None.
    """

    def __init__(self, scorer: WindowScore, threshold: Threshold | None = None, every: int = 1) -> None:
        require_whole("detector: every", every, 1)
        self.scorer, self.every, self.calibration = scorer, every, threshold
        self.threshold = None if threshold is None else threshold.value
        self._empty()

    def calibrated(self, states: Any, actions: Any, rate: float) -> "WindowDetector":
        """The same with a threshold at a false-positive rate, from nominal windows that nothing was fitted to.

        Raises:
          InputError: too few windows for the rate (`rates.wanted`), or windows of another robot.
        """
        scores = self.scorer.score(*checked(self.scorer, states, actions))
        return WindowDetector(self.scorer, threshold_at(scores, rate), self.every)

    def require(self, observations: Any, actions: Any) -> None:
        """Refuse an environment whose transitions cannot be scored.

        Args:
          observations, actions: Gymnasium's spaces of one simulation.

        Raises:
          InputError: `proprio` or actions of another size, or a scorer that they do not suffice for.
        """
        if isinstance(observations, Mapping):  # a space of several, in which `in` asks for samples
            observations = dict(observations.items())
        spaces = _proprio(observations), actions
        wanted = self.scorer.states, self.scorer.actions
        for name, space, width in zip(("observation", "action"), spaces, wanted, strict=True):
            if space.shape != (width,):
                raise InputError(f"detector: an {name} must have {width} entries, and here it has shape {space.shape}")
        suffices = getattr(self.scorer, "require_observed", None)
        if suffices is not None:
            suffices()

    @property
    def _unseen(self) -> float:
        return 0.0 if self.threshold is None or self.threshold > 0 else -np.inf

    def _empty(self) -> None:
        self._states: Array | None = None

    def reset(self, rows: NDArray[np.bool_] | None = None) -> None:
        """See `wrappers.anomaly.Detector`."""
        if rows is None or self._states is None:
            self._empty()
        else:
            self._count[rows], self._score[rows] = 0, self._unseen

    def update(self, obs: Any, action: Any, next_obs: Any) -> Any:
        """See `wrappers.anomaly.Detector`; observations are `proprio`, or dicts that hold it.

        Raises:
          InputError: observations or actions of other sizes, or not finite.
        """
        before, act, after = (np.asarray(x, float) for x in (_proprio(obs), action, _proprio(next_obs)))
        single = act.ndim == 1
        if single:
            before, act, after = before[None], act[None], after[None]
        kept = self._keep(before, act, after)
        due = (self._count >= self.scorer.horizon) & ((self._count - self.scorer.horizon) % self.every == 0)
        if due.any():
            windows, by_row = (
                checked(self.scorer, kept[due], self._actions[due]),
                getattr(self.scorer, "score_rows", None),
            )
            # Some scorers must know whose windows these are: which ground a row stands on.
            self._score[due] = self.scorer.score(*windows) if by_row is None else by_row(*windows, np.flatnonzero(due))
        return float(self._score[0]) if single else self._score.copy()

    def _keep(self, before: Array, act: Array, after: Array) -> Array:
        """(n, H+1, s), the last states of each episode."""
        h, s, a = self.scorer.horizon, self.scorer.states, self.scorer.actions
        for name, x, width in (("observation", before, s), ("action", act, a), ("observation", after, s)):
            if x.ndim != 2 or x.shape[1] != width:
                raise InputError(f"detector: an {name} must have {width} entries, got shape {x.shape[1:]}")
            if not np.isfinite(x).all():
                raise InputError(f"detector: an {name} holds {x[~np.isfinite(x)][0]:g}; every entry must be finite")
        n = len(act)
        if self._states is None or len(self._states) != n:
            self._states, self._actions = np.zeros((n, h + 1, s)), np.zeros((n, h, a))
            self._count, self._score = np.zeros(n, np.intp), np.full(n, self._unseen)
        self._states[:, :-1] = self._states[:, 1:]
        self._actions[:, :-1] = self._actions[:, 1:]
        # At an episode's first transition the state before it was not seen yet.
        self._states[:, -2], self._states[:, -1], self._actions[:, -1] = before, after, act
        self._count += 1
        return self._states


class Either:
    """Alarms where one of several detectors does: the score is the largest of their scores over their thresholds.

    Its own false-positive rate is at most the sum of theirs.

    Args:
      detectors: with thresholds above 0.

    Raises:
      InputError: there is none, or one without a threshold above 0.
    """

    threshold = 1.0

    def __init__(self, detectors: Sequence[Any]) -> None:
        limits = [getattr(d, "threshold", None) for d in detectors]
        if not limits or any(t is None or not t > 0 for t in limits):
            raise InputError(f"Either: want detectors whose thresholds are above 0, got thresholds {limits}")
        self.detectors, self.limits = tuple(detectors), tuple(float(t) for t in limits if t is not None)

    def require(self, observations: Any, actions: Any) -> None:
        """Refuse an environment that one of them refuses."""
        for detector in self.detectors:
            if (ask := getattr(detector, "require", None)) is not None:
                ask(observations, actions)

    def reset(self, rows: NDArray[np.bool_] | None = None) -> None:
        """Of all of them."""
        for detector in self.detectors:
            detector.reset(rows)

    def update(self, obs: Any, action: Any, next_obs: Any) -> Any:
        """The largest score over its threshold."""
        parts = zip(self.detectors, self.limits, strict=True)
        scores = np.stack([np.asarray(d.update(obs, action, next_obs), float) / limit for d, limit in parts])
        return scores.max(0)[()]


def _proprio(obs: Any) -> Any:
    if not isinstance(obs, Mapping):
        return obs
    if "proprio" not in obs:
        raise InputError(f"detector: the observation has no 'proprio'; it has: {', '.join(map(str, obs))}")
    return obs["proprio"]
