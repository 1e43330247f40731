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
    np.testing.assert_allclose(
        running.losses(PLANT, x), whole._told(0, PLANT, x).sum(1) + whole._told(1, PLANT, x).sum(1)
    )


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
