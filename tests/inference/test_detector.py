"""Windows out of transitions, under `MonitorAnomaly` and without."""

from itertools import pairwise

import gymnasium
import numpy as np
import pytest

from nfc_gym.core import InputError
from nfc_gym.inference.detector import Either, WindowDetector, checked
from nfc_gym.inference.rates import Threshold
from nfc_gym.wrappers import MonitorAnomaly


class Farthest:
    """Scores a window by how far its last state lies from its first, plus the sum of its actions."""

    horizon, states, actions = 3, 2, 1

    def score(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        assert states.shape[1:] == (4, 2)
        assert actions.shape[1:] == (3, 1)
        return states[:, -1, 0] - states[:, 0, 0] + actions.sum((1, 2))


def walk(detector: WindowDetector, steps: range) -> list[float]:
    return [detector.update(np.array([t, 0.0]), np.array([0.1]), np.array([t + 1, 0.0])) for t in steps]


def test_scores_begin_once_a_window_is_there_and_again_after_a_reset() -> None:
    detector = WindowDetector(Farthest())
    assert walk(detector, range(5)) == pytest.approx([0, 0, 3.3, 3.3, 3.3])
    detector.reset()
    assert walk(detector, range(10, 13)) == pytest.approx([0, 0, 3.3])


def test_rows_are_reset_apart() -> None:
    detector = WindowDetector(Farthest())
    out = []
    for t in range(5):
        state, step = np.array([[t, 0.0], [2.0 * t, 0.0]]), np.array([[1, 0], [2, 0]])
        out.append(detector.update(state, np.zeros((2, 1)), state + step))
        if t == 2:
            detector.reset(np.array([False, True]))
    np.testing.assert_allclose(out, [[0, 0], [0, 0], [3, 6], [3, 0], [3, 0]])


def test_every_holds_scores_in_between() -> None:
    detector = WindowDetector(Farthest(), every=2)
    given = [0.0, 1.0, 3.0, 6.0, 10.0, 15.0]
    out = [detector.update([a, 0], [0.0], [b, 0]) for a, b in pairwise(given)]
    assert out == pytest.approx([0, 0, 6, 6, 12])


def test_bad_windows_and_transitions_are_refused() -> None:
    states, actions = np.zeros((5, 4, 2)), np.zeros((5, 3, 1))
    assert checked(Farthest(), np.zeros((5, 6, 2)), np.zeros((5, 5, 1)))[0].shape == (5, 4, 2)
    with pytest.raises(InputError, match="2 steps; this detector needs 3"):
        checked(Farthest(), states[:, 1:], actions[:, 1:])
    with pytest.raises(InputError, match="another robot"):
        checked(Farthest(), np.zeros((5, 4, 7)), actions)
    with pytest.raises(InputError, match="states holds nan"):
        checked(Farthest(), np.where(np.arange(2), states, np.nan), actions)
    with pytest.raises(InputError, match="an action holds inf"):
        WindowDetector(Farthest()).update([0.0, 0], [np.inf], [1.0, 0])
    with pytest.raises(InputError, match="2 entries, got shape"):
        WindowDetector(Farthest()).update([0.0], [0.0], [1.0])
    with pytest.raises(InputError, match="no 'proprio'"):
        WindowDetector(Farthest()).update({"pixels": 0}, [0.0], {"pixels": 0})
    with pytest.raises(InputError, match="held-out windows"):
        WindowDetector(Farthest()).calibrated(states, actions, 0.01)


def test_calibrated_keeps_what_its_threshold_comes_from() -> None:
    rng = np.random.default_rng(0)
    detector = WindowDetector(Farthest()).calibrated(rng.random((400, 4, 2)), rng.random((400, 3, 1)), 0.01)
    assert detector.calibration is not None
    assert (detector.calibration.rate, detector.calibration.windows) == (0.01, 400)
    assert detector.threshold == detector.calibration.value


def test_either_alarms_where_one_does() -> None:
    def fixed(threshold: float) -> WindowDetector:
        return WindowDetector(Farthest(), Threshold(threshold, 0.01, 300, 0.0, 0.02))

    both = Either([fixed(2.0), fixed(10.0)])
    assert both.threshold == 1
    assert walk(both, range(3)) == pytest.approx([0, 0, 3.3 / 2])  # type: ignore[arg-type]
    with pytest.raises(InputError, match="above 0"):
        Either([fixed(2.0), WindowDetector(Farthest())])


class Line(gymnasium.Env):
    """Walks on a line by its action."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gymnasium.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        self.x = 0.0
        return np.array([self.x, 0], np.float32), {}

    def step(self, action: np.ndarray) -> tuple:
        self.x += float(action[0])
        return np.array([self.x, 0], np.float32), 0.0, False, False, {}


def test_under_the_wrapper() -> None:
    env = MonitorAnomaly(Line(), WindowDetector(Farthest(), Threshold(3.5, 0.01, 300, 0.0, 0.02)))
    env.reset(seed=0)
    told = [env.step(np.array([a]))[4] for a in (0.5, 0.5, 0.5, 1.0)]
    assert [float(i["anomaly_score"]) for i in told] == pytest.approx([0, 0, 3, 4])
    assert [bool(i["anomaly"]) for i in told] == [False, False, False, True]


def test_what_has_not_been_seen_alarms_nobody() -> None:
    """Log odds of healthy windows are below 0, and so may be the threshold."""
    env = MonitorAnomaly(Line(), WindowDetector(Farthest(), Threshold(-2.0, 0.01, 300, 0.0, 0.02)))
    for _ in range(2):  # begun anew too
        env.reset(seed=0)
        told = [env.step(np.array([a]))[4] for a in (-1.0, -1.0, -1.0, 1.5)]
        assert [bool(i["anomaly"]) for i in told] == [False, False, False, True]
    detector = WindowDetector(Farthest(), Threshold(-2.0, 0.01, 300, 0.0, 0.02))
    for _ in range(3):
        detector.update(np.zeros((2, 2)), np.zeros((2, 1)), np.zeros((2, 2)))
    detector.reset(np.array([True, False]))
    score = detector.update(np.zeros((2, 2)), np.zeros((2, 1)), np.zeros((2, 2)))
    assert (score >= detector.threshold).tolist() == [False, True]
