"""Fits that begin elsewhere: the likeliest hollow is found, and the others say what is open."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nfc_gym.measured import elsewhere
from nfc_gym.measured.box import box
from nfc_gym.measured.elsewhere import hollows, resized
from nfc_gym.measured.fit import Fit, jacobian
from nfc_gym.measured.metric import metric
from nfc_gym.measured.problem import Columns, Problem


class Wells(Problem):
    """Errors x^2 - 1 + tilt x: hollows near -1 and 1, the deeper one near -1 for a positive tilt.

    Models beyond zero expect `loud` times the noise of the others.
    """

    def __init__(self, tilt: float, loud: float = 1.0, rough: bool = True, blocks: int = 10) -> None:
        self.tilt, self.loud, self.rough = tilt, loud, rough
        self.mask = np.ones((blocks, 2), bool)
        self.log_of, self.time_of, self.names = np.zeros(blocks, int), np.arange(float(blocks)), ("log",)
        self.asked: list[int] = []
        self.columns = Columns(("a", "b"), ("1", "1"), np.zeros(2), ("joint:j",) * 2)

    def residual(self, plant: Any, x: np.ndarray) -> np.ndarray:
        depth = np.stack([x[:, 0] ** 2 - 1, self.tilt * (x[:, 0] + 1)], -1)
        return np.repeat(depth[:, None], len(self), 1)

    def covariance(self, plant: Any, x: np.ndarray) -> np.ndarray:
        self.asked.append(len(self))
        return np.broadcast_to(0.1**2 * (self.loud if x[0] > 0 else 1.0) ** 2 * np.eye(2), (len(self), 2, 2))

    def take(self, index: np.ndarray) -> "Wells":
        out = Wells(self.tilt, self.loud, self.rough, len(index))
        out.asked = self.asked
        return out

    def synthetic(self, plant, x, rng): ...  # type: ignore[override]


def stood(problem: Wells, x: float) -> tuple[Any, Fit]:
    space = SimpleNamespace(low=np.array([-2.0]), high=np.array([2.0]), free=np.ones(1, bool))
    same = lambda x: x  # noqa: E731
    plant: Any = SimpleNamespace(space=space, effects=(), null=np.zeros(1), chart=same, unchart=same, size=1)
    under = metric(problem, problem.covariance(plant, np.zeros(1)))
    white = under.whiten(problem.residual(plant, np.array([[x]])))[0]
    slopes = jacobian(problem, under, box(plant), np.array([x]), white, np.array([0]))
    return under, Fit(plant, np.array([x]), white, slopes)


def test_the_deeper_hollow_is_kept_and_the_other_says_what_is_open() -> None:
    problem = Wells(0.1)
    under, shallow = stood(problem, 1.0)
    found = hollows(problem, under, np.zeros(2), shallow, 0, (np.array([-0.8]),))
    assert found.x == pytest.approx(-1.0, abs=0.02)
    assert 0.5 < found.unsure[0] < 2.1  # the fit at hand, at least, is two away


@pytest.mark.parametrize(("loud", "end"), [(0.2, 1.0), (1.0, -1.0)])
def test_the_likeliest_is_not_the_one_with_the_smallest_errors(loud: float, end: float) -> None:
    """Near 1 an error of 0.02 is left, near -1 none; but who expects a noise of 0.02 is surer than who expects 0.1."""
    problem = Wells(0.01, loud)
    under, exact = stood(problem, -1.0)
    assert hollows(problem, under, np.zeros(2), exact, 0, (np.array([0.9]),)).x == pytest.approx(end, abs=0.02)


def test_who_is_far_behind_on_some_of_the_blocks_is_not_asked_of_all() -> None:
    problem = Wells(0.1, blocks=36)
    under, shallow = stood(problem, 1.0)
    found = hollows(problem, under, np.zeros(2), shallow, 0, (np.array([-0.8]),))
    assert found.x == pytest.approx(-1.0, abs=0.02)
    assert set(problem.asked[1:]) == {12}  # the first was the metric's
    once = len(problem.asked)
    even = Wells(0.0, blocks=36)  # two hollows alike: neither is lost early
    under, one = stood(even, 1.0)
    hollows(even, under, np.zeros(2), one, 0, (np.array([-0.8]),))
    assert even.asked[1:] == [12] * 3 * (once - 1)


@pytest.mark.parametrize(("told", "there"), [(-1.04, True), (-0.94, False)])
def test_who_ends_near_where_noise_was_told_is_not_asked_again(told: float, there: bool) -> None:
    problem, asked = Wells(0.0), list[float]()
    under, deep = stood(problem, -1.0)
    covariance = problem.covariance
    problem.covariance = lambda plant, x: asked.append(x[0]) or covariance(plant, x)  # type: ignore[method-assign]
    found = hollows(problem, under, np.zeros(2), deep, 0, (np.array([0.8]),), told=np.array([told]))
    assert found.told is not None
    assert (found.told == told) == there
    assert found.told == pytest.approx(-1.0, abs=0.05)
    assert any(x == told for x in asked) == there
    assert min(asked, key=lambda x: abs(x - 1)) == pytest.approx(1.0, abs=0.02)  # the other hollow's noise is its own


def test_where_nothing_touches_the_fit_at_hand_is_the_answer() -> None:
    problem = Wells(0.1, rough=False)
    under, shallow = stood(problem, 1.0)
    found = hollows(problem, under, np.zeros(2), shallow, 0, (np.array([-0.8]),))
    assert found.x == 1.0
    assert found.unsure == 0.0


def test_fits_that_end_in_one_hollow_are_not_compared_and_soon_suffice() -> None:
    problem = Wells(0.1)
    under, deep = stood(problem, -1.0)
    problem.covariance = None  # type: ignore[assignment]  (asking for it would fail)
    begun: list[int] = []
    found = hollows(problem, under, np.zeros(2), deep, 0, starts=6, tick=begun.append)
    assert begun == [1, 2]
    assert found.x == pytest.approx(-1.0, abs=0.02)
    assert found.unsure < 0.02


@pytest.mark.parametrize(("tilt", "end"), [(0.1, -1.0), (-0.1, -1.0), (0.0, 1.0)])
def test_an_effects_other_sizes_are_tried_and_kept_where_they_end_lower(
    monkeypatch: pytest.MonkeyPatch, tilt: float, end: float
) -> None:
    """A delay that is found a period too short sits in a hollow of its own; of two alike the one at hand stays."""
    problem = Wells(tilt, rough=False)
    param, shape = SimpleNamespace(shape=False, probes=(-0.7, 0.6)), SimpleNamespace(shape=True, probes=(5.0,))
    plant: Any = SimpleNamespace(space=(), effects=(SimpleNamespace(params=(param, shape)),))
    under = metric(problem, problem.covariance(plant, np.zeros(2)))

    def stand(problem: Any, under: Any, plant: Any, x: np.ndarray, rounds: int = 0) -> Fit:
        """The bottom of the hollow that x is in."""
        x = np.array([np.sign(x[0]), x[1]])
        return Fit(plant, x, under.whiten(problem.residual(plant, x[None]))[0], np.zeros((len(problem), 2, 0)))

    monkeypatch.setattr(elsewhere, "fit", stand)
    found = stand(problem, under, plant, np.array([1.0, 3.0]))
    assert resized(problem, under, found).x.tolist() == [end, 3.0]
    monkeypatch.setattr(Wells, "residual", lambda self, plant, x: np.full((len(x), len(self), 2), np.nan))
    assert resized(problem, under, found) is found, "no size that was tried is simulated to its end"
    bare = Fit(SimpleNamespace(space=(), effects=()), found.x, found.white, found.jacobian)  # type: ignore[arg-type]
    assert resized(problem, under, bare) is bare
