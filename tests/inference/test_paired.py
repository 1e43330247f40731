"""Rounds of pairs against posteriors that are known."""

import numpy as np
import pytest
from numpy.typing import NDArray

from nfc_gym.core import InputError
from nfc_gym.inference import paired
from nfc_gym.inference.paired import LAST, Normal, close_in
from nfc_gym.inference.progress import Quiet

Array = NDArray[np.float64]
KNOWN, OUTPUTS, UNSEEN = 6, 60, 4


class Linear:
    """Outputs y = A theta + C w + noise, the noise of sensors N(0, I); w of motors."""

    def __init__(self, seed: int, bend: float = 0.0) -> None:
        rng = np.random.default_rng(seed)
        told = np.geomspace(0.05, 3, KNOWN)  # from hardly at all to a tenth of the prior
        self.slope = rng.standard_normal((OUTPUTS, KNOWN)) * told
        self.motors = 2 * rng.standard_normal((OUTPUTS, UNSEEN))
        self.bend = bend
        self.truth = rng.standard_normal(KNOWN)
        self.asked = 0
        self.seen = self.out(self.truth[None], rng)[0] + rng.standard_normal(OUTPUTS)

    def out(self, theta: Array, rng: np.random.Generator) -> Array:
        ends = theta @ self.slope.T
        return ends + self.bend * ends**2 + rng.standard_normal((len(theta), UNSEEN)) @ self.motors.T

    def __call__(self, theta: Array, seed: int) -> Array:
        self.asked += len(theta)
        return self.seen - self.out(theta, np.random.default_rng(seed))

    def exact(self) -> Normal:
        noise = np.eye(OUTPUTS) + self.motors @ self.motors.T
        precision = np.eye(KNOWN) + self.slope.T @ np.linalg.solve(noise, self.slope)
        covariance = np.asarray(np.linalg.inv(precision), float)
        return Normal(covariance @ self.slope.T @ np.linalg.solve(noise, self.seen), covariance)


NOTHING = Normal(np.zeros(KNOWN), np.eye(KNOWN))


@pytest.mark.parametrize("seed", range(4))
def test_what_is_linear_comes_out_as_it_is(seed: int) -> None:
    problem = Linear(seed)
    found, exact = close_in(problem, NOTHING, KNOWN, 8000, seed), problem.exact()
    off = np.linalg.solve(np.linalg.cholesky(exact.covariance), found.mean - exact.mean)
    assert np.sqrt(np.square(off).mean()) < 0.25  # of a standard deviation
    spread = np.sqrt(np.linalg.eigvals(np.linalg.solve(exact.covariance, found.covariance)).real)
    assert spread.min() > 0.9
    assert spread.max() < 1.25
    assert found.told(KNOWN) > 0.9 * exact.told(KNOWN)


def test_it_ends_where_rounds_tell_no_more() -> None:
    problem = Linear(0)
    close_in(problem, problem.exact(), KNOWN, 80_000)
    assert problem.asked <= 2 * paired.PAIRS * (LAST + 3)


def test_what_is_bent_is_found_from_afar_and_held() -> None:
    """A normal can not be right where the likelihood is bent; it is to hold the truth as often as it says."""
    squares = []
    for seed in range(12):
        problem = Linear(100 + seed, bend=0.05)
        found = close_in(problem, NOTHING, KNOWN, 8000, seed)
        off = problem.truth - found.mean
        squares.append(off @ np.linalg.solve(found.covariance, off) / KNOWN)
        assert found.told(KNOWN) > 0.8
    assert np.mean(squares) < 1.4
    assert max(squares) < 5


def test_it_may_begin_elsewhere() -> None:
    """Where the first round lies has no say in the answer."""
    problem = Linear(1)
    exact = problem.exact()
    aside = Normal(exact.mean + 4 * np.sqrt(np.diag(exact.covariance)), exact.covariance)
    found = close_in(problem, aside, KNOWN, 16_000)
    off = np.linalg.solve(np.linalg.cholesky(exact.covariance), found.mean - exact.mean)
    assert np.sqrt(np.square(off).mean()) < 0.3


def test_some_that_come_apart_are_left_out_and_most_are_refused() -> None:
    problem = Linear(2)

    def torn(theta: Array, seed: int) -> Array:
        out = problem(theta, seed)
        out[theta[:, 0] > problem.truth[0] + 1.5] = np.nan
        return out

    assert np.isfinite(close_in(torn, NOTHING, KNOWN, 4000).mean).all()
    with pytest.raises(InputError, match="does not fit this robot"):
        close_in(lambda theta, seed: np.full((len(theta), OUTPUTS), np.nan), NOTHING, KNOWN, 4000)


def test_too_few_simulations_are_refused_and_enough_are_named() -> None:
    with pytest.raises(InputError, match="100 simulations are too few for 6 unknowns; want 128 or more"):
        close_in(Linear(0), NOTHING, KNOWN, 100)
    close_in(Linear(0), NOTHING, KNOWN, 128)


def test_progress_is_told_and_a_seed_gives_the_same_bits() -> None:
    class Heard(Quiet):
        said: list[str]

        def message(self, text: str) -> None:
            self.said.append(text)

    heard = Heard()
    heard.said = []
    one = close_in(Linear(3), NOTHING, KNOWN, 3200, 7, heard)
    other = close_in(Linear(3), NOTHING, KNOWN, 3200, 7)
    assert heard.said[0].startswith("round 1 of 4 at most, 800 simulations each: ")
    assert (one.mean == other.mean).all()
    assert (one.covariance == other.covariance).all()
