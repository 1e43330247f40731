"""Regression and Bayes' rule on robots that are linear, whose answer is known."""

import numpy as np
import pytest

from nfc_gym import InputError
from nfc_gym.adaptation.linear import QUIET, as_seen, cost, regressed

N, K, D = 30, 2, 3


def missed(z: np.ndarray, truth: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """(m, N, K): what replays under z miss of a robot that is as `truth`, and linear."""
    return np.einsum("nkd,md->mnk", slope, truth - z)


def test_a_linear_robot_is_found_and_what_came_apart_is_left_out() -> None:
    rng = np.random.default_rng(0)
    slope, truth = rng.standard_normal((N, K, D)), np.array([0.5, -1.0, 2.0])
    z = rng.standard_normal((40, D))
    off = missed(z, truth, slope)
    off[3, 1, 0] = np.nan
    linear = regressed(z, off)
    np.testing.assert_allclose(linear.slope, slope, atol=1e-9)
    assert linear.left.max() < 1e-15
    sharp = 1e-4 * np.tile(np.eye(K), (N, 1, 1))
    mean, covariance = linear.posterior(sharp, np.ones(D))
    np.testing.assert_allclose(mean, truth, atol=1e-3)
    assert np.sqrt(np.diag(covariance)).max() < 1e-2
    kept, _ = linear.posterior(sharp, np.array([1.0, 1e-12, 1.0]))
    assert abs(kept[1]) < 1e-3, "a prior that says no"
    best = cost(np.array([truth, truth + 0.1]), np.ones(D), missed(np.array([truth, truth + 0.1]), truth, slope), sharp)
    assert best[0] < best[1]
    with pytest.raises(InputError, match="come apart"):
        regressed(z, np.full_like(off, np.nan))


def test_noise_is_what_the_best_replays_miss_and_sensors_keep_theirs() -> None:
    rng = np.random.default_rng(1)
    rest = np.array([[4.0, 1.0, 0.0], [1.0, 4.0, 0.0], [0.0, 0.0, 0.0]])
    noise = np.tile(np.eye(3) + rest, (4000, 1, 1))
    found = as_seen(noise, rng.standard_normal((4000, 3)) * (3.0, 0.01, 2.0))[0]
    np.testing.assert_allclose(found[0, 0], 9.0, rtol=0.1)
    np.testing.assert_allclose(found[1, 1], QUIET, rtol=0.3, err_msg="better sensors than were assumed")
    np.testing.assert_allclose(found[2, 2], 4.0, rtol=0.1, err_msg="where nothing but the sensor was assumed")
    assert np.linalg.eigvalsh(found).min() > 0.9 * QUIET
    quiet = as_seen(noise, rng.standard_normal((4000, 3)))[0]
    np.testing.assert_allclose(quiet, np.eye(3), atol=0.1, err_msg="sensors' noise alone, and none of the rest")
