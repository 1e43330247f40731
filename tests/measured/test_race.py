"""A race finds what leaves least, and asks few blocks of what is far behind."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nfc_gym.measured.metric import Metric
from nfc_gym.measured.problem import Columns, Problem
from nfc_gym.measured.race import Race, lost


class Targets(Problem):
    """One number a block: how far the parameter is from that block's own target."""

    def __init__(self, target: np.ndarray, asked: list[int] | None = None) -> None:
        self.target, self.asked = target, [] if asked is None else asked
        self.mask = np.ones((len(target), 1), bool)
        self.log_of, self.time_of, self.names = np.zeros(len(target), int), np.arange(float(len(target))), ("log",)
        self.columns = Columns(("a",), ("1",), np.zeros(1), ("joint:j",))

    def residual(self, plant: Any, x: np.ndarray) -> np.ndarray:
        self.asked.append(len(x) * len(self))
        return (self.target - x)[..., None]

    def covariance(self, plant, x): ...  # type: ignore[override]

    def take(self, index: np.ndarray) -> "Targets":
        return Targets(self.target[index], self.asked)

    def synthetic(self, plant, x, rng): ...  # type: ignore[override]


def race(target: np.ndarray) -> tuple[Race, Targets]:
    problem = Targets(target)
    return Race(problem, Metric(np.ones((len(target), 1, 1)), problem.mask)), problem


PLANT: Any = SimpleNamespace()


def test_wild_draws_are_asked_of_a_third_of_the_blocks() -> None:
    running, problem = race(np.random.default_rng(0).normal(size=30))
    x = np.array([0.0, 0.1, *range(30, 40)])[:, None]
    losses = running.losses(PLANT, x)
    assert losses.argmin() in (0, 1)
    assert np.isinf(losses[2:]).all()
    assert sum(problem.asked) == 12 * 10 + 2 * 20


def test_those_that_stay_have_the_losses_of_all_blocks() -> None:
    running, problem = race(np.random.default_rng(1).normal(size=14))
    x = np.array([[0.0], [0.2], [-0.1]])
    whole = Race(problem, Metric(np.ones((14, 1, 1)), problem.mask))
    np.testing.assert_allclose(running.losses(PLANT, x), sum(whole._told(k, PLANT, x).sum(1) for k in range(3)))


def test_who_is_lost_is_ranked_by_what_was_seen_of_it_and_behind_all_that_are_not() -> None:
    running, problem = race(np.random.default_rng(3).normal(size=30))
    x = np.array([0.0, 0.1, 9.0, 5.0, 7.0])[:, None]
    losses, ranked = running.ranked(PLANT, x)
    assert np.isinf(losses[2:]).all()
    np.testing.assert_array_equal(np.argsort(ranked)[2:], [3, 4, 2])
    np.testing.assert_array_equal(ranked[:2], running.losses(PLANT, x)[:2])
    whole = Race(Targets(problem.target[:3]), Metric(np.ones((3, 1, 1)), problem.mask[:3]))  # too few to race
    np.testing.assert_allclose(ranked[2:], 10 * whole.losses(PLANT, x)[2:], rtol=0.3)


def test_who_is_lost_on_the_second_third_is_not_asked_of_the_last() -> None:
    running, _ = race(np.zeros(60))
    told = {0: 1.0 + 0.9 * (-1.0) ** np.arange(20), 1: np.full(20, 3.0)}
    rows = lambda k: np.stack([np.ones(20), told[k]])  # noqa: E731
    asked: list[int] = []
    running._told = lambda k, plant, x: asked.append(len(x)) or (rows(k) if k < 2 else np.ones((len(x), 20)))  # type: ignore[method-assign]
    assert np.isinf(running.losses(PLANT, np.zeros((2, 1)))).tolist() == [False, True]
    assert asked == [2, 2, 1]


@pytest.mark.parametrize("count", [1, 2, 11])
def test_few_blocks_are_all_asked(count: int) -> None:
    """Differences over three blocks have no scatter to speak of."""
    running, problem = race(np.zeros(count))
    assert np.isfinite(running.losses(PLANT, np.array([[0.0], [9.0]]))).all()
    assert problem.asked == [2 * count]


def test_what_shows_in_few_blocks_alone_stays_in_the_race() -> None:
    """A limit that one block in ten reaches gains nothing where it is not reached, and is not behind there."""
    told = np.random.default_rng(2).normal(size=20) ** 2
    other = told + np.where(np.arange(20) == 7, 25.0, 0.0)
    assert not lost(np.stack([told, other])).any()
    assert lost(np.stack([told, told + 5.0])).tolist() == [False, True]
