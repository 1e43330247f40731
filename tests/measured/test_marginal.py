"""Fits over drawn starts: a slope far below the jumps is found, and how well it is known is said."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nfc_gym.measured.elsewhere import Ended
from nfc_gym.measured.fit import Fit, stand, uncertainty
from nfc_gym.measured.marginal import marginal
from nfc_gym.measured.metric import metric
from nfc_gym.measured.problem import Columns
from nfc_gym.measured.shooting import RolloutProblem

TRUE = np.array([0.4, -0.3])
SLOPES = np.array([10.0, 0.3])  # of a number by each parameter, along a mean over all starts
BLOCKS, NUMBERS = 300, 4


class Jumps(RolloutProblem):
    """Numbers that grow as psi is off, and are thrown by up to a half at any change of psi or start."""

    def __init__(self, noise: int, start: int = 0) -> None:
        self.rough, self.start = True, start
        self.mask = np.ones((BLOCKS, NUMBERS), bool)
        self.log_of, self.time_of, self.names = np.zeros(BLOCKS, int), np.arange(float(BLOCKS)), ("log",)
        self.columns = Columns(("a",) * NUMBERS, ("1",) * NUMBERS, np.ones(NUMBERS), ("joint:j",) * NUMBERS)
        rng = np.random.default_rng(noise)
        self.noise, self.sign = rng.normal(size=(BLOCKS, NUMBERS)), rng.choice([-1.0, 1.0], (BLOCKS, NUMBERS, 2))

    def residual(self, plant: Any, x: np.ndarray) -> np.ndarray:
        line = np.einsum("smk,pk->psm", self.sign * SLOPES, TRUE - x)
        own = np.random.default_rng([7, self.start]).uniform(1e5, 2e5, (BLOCKS, NUMBERS, 2))
        return line + self.noise + 0.5 * np.sin(np.einsum("smk,pk->psm", own, x))

    def covariance(self, plant: Any, x: np.ndarray) -> np.ndarray:
        return np.broadcast_to(1.1 * np.eye(NUMBERS), (BLOCKS, NUMBERS, NUMBERS))

    def redrawn(self, rng: np.random.Generator) -> "Jumps":
        out = object.__new__(Jumps)
        out.__dict__.update(self.__dict__)
        out.start = int(rng.integers(1, 2**31))
        return out


def found(noise: int, at: np.ndarray) -> tuple[Fit, Ended]:
    space = SimpleNamespace(low=np.full(2, -2.0), high=np.full(2, 2.0), free=np.ones(2, bool))
    same = lambda x: x  # noqa: E731
    plant: Any = SimpleNamespace(space=space, effects=(), null=np.zeros(2), chart=same, unchart=same, size=2)
    problem = Jumps(noise)
    under = metric(problem, problem.covariance(plant, at))
    before = stand(problem, under, plant, at)
    return before, marginal(problem, under, before, seed=noise)


@pytest.mark.parametrize("noise", range(3))
def test_a_slope_below_the_jumps_is_found_and_its_doubt_is_honest(noise: int) -> None:
    before, after = found(noise, np.array([0.6, 0.7]))
    assert (np.abs(after.x - TRUE) < 3 * after.unsure).all()
    assert abs(after.x[1] - TRUE[1]) < 0.4
    # a slope of 0.3 in 1200 numbers of unit noise is known to a tenth, and what makes up for jumps comes on top
    assert 0.05 < after.unsure[1] < 0.4
    assert after.unsure[0] < 0.02
    plain = uncertainty(before, np.arange(BLOCKS))
    assert plain[1] < 0.5 * after.unsure[1], "the squares of jumps count as slopes in it"


def test_the_same_seed_ends_with_the_same_bits() -> None:
    one, two = (found(1, np.array([0.6, 0.7]))[1] for _ in range(2))
    np.testing.assert_array_equal(one.x, two.x)
    np.testing.assert_array_equal(one.unsure, two.unsure)


def test_what_is_no_roll_out_stays_as_it_is() -> None:
    before, _ = found(0, np.array([0.6, 0.7]))
    other: Any = SimpleNamespace(rough=True)
    ended = marginal(other, SimpleNamespace(), before, 0)  # type: ignore[arg-type]
    np.testing.assert_array_equal(ended.x, before.x)
    assert not ended.unsure.any()
