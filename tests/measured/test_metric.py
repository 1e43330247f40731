"""Whitening gives unit variance under its own covariance; the loss is a square near zero and a line far out."""

from collections.abc import Callable

import numpy as np
import pytest

from nfc_gym.measured.metric import TURN, likeliest_slack, loss, loss_weight, metric, unexplained_variance
from nfc_gym.measured.problem import Columns, Problem

SIZE, WIDTH = 3, 5


class Plain(Problem):
    """Blocks of numbers without a machine behind them: what a metric needs to know, and no more."""

    def __init__(self, mask: np.ndarray) -> None:
        width = mask.shape[1]
        self.mask, self.log_of, self.names = mask, np.zeros(len(mask), int), ("log",)
        self.time_of = np.arange(len(mask)) * 0.4
        self.columns = Columns(
            tuple("ab"[k % 2] for k in range(width)), ("1",) * width, np.zeros(width), ("joint:j",) * width
        )

    def residual(self, plant, x): ...  # type: ignore[override]
    def covariance(self, plant, x): ...  # type: ignore[override]
    def take(self, index): ...  # type: ignore[override]
    def synthetic(self, plant, x, rng): ...  # type: ignore[override]


def covariance() -> np.ndarray:
    """(S, m, m) positive definite, columns of very different sizes, strongly correlated."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(SIZE, WIDTH, WIDTH)) * np.array([1e-4, 1, 30, 1e-2, 5])[:, None]
    return root @ root.transpose(0, 2, 1) + np.diag([1e-8, 0.1, 90, 1e-4, 2.5])


def draw(sigma: np.ndarray, count: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    return np.einsum("sij,psj->psi", np.linalg.cholesky(sigma), rng.normal(size=(count, *sigma.shape[:2])))


def test_residuals_of_the_covariance_become_white() -> None:
    sigma = covariance()
    white = metric(Plain(np.ones((SIZE, WIDTH), bool)), sigma).whiten(draw(sigma, 40_000))
    for s in range(SIZE):
        np.testing.assert_allclose(np.cov(white[:, s].T), np.eye(WIDTH), atol=0.04)
    assert white.mean() == pytest.approx(0, abs=0.02)


def test_extra_variance_is_added_to_each_column() -> None:
    sigma, extra = covariance(), np.array([1e-6, 0.0, 400.0, 0.0, 1.0])
    white = metric(Plain(np.ones((SIZE, WIDTH), bool)), sigma, extra).whiten(draw(sigma + np.diag(extra), 40_000))
    np.testing.assert_allclose(white.var(0), 1, atol=0.04)


def test_what_is_masked_is_zero_and_touches_nothing_else() -> None:
    sigma = covariance()
    mask = np.ones((SIZE, WIDTH), bool)
    mask[0, 1] = mask[2, 0] = mask[2, 4] = False
    residual = draw(sigma, 40_000)
    under = metric(Plain(mask), sigma)
    white = under.whiten(residual)
    assert (white[:, ~mask] == 0).all()
    np.testing.assert_allclose(white.var(0)[mask], 1, atol=0.04)
    wild = np.where(mask, residual, 1e9)
    np.testing.assert_array_equal(under.whiten(wild)[:, mask], white[:, mask])
    some = np.array([2, 0])
    np.testing.assert_array_equal(under.take(some).whiten(residual[:, some]), white[:, some])


def test_an_unstable_block_counts_as_far_off_but_finite() -> None:
    sigma = covariance()
    mask = np.ones((SIZE, WIDTH), bool)
    mask[1, 2] = False
    residual = draw(sigma, 2)
    residual[0, 1] = np.nan
    residual[1, 2, 3] = np.inf
    white = metric(Plain(mask), sigma).whiten(residual)
    assert np.isfinite(white).all()
    assert (np.abs(white[0, 1][mask[1]]) >= 10).all()
    assert white[0, 1, 2] == 0
    assert (np.abs(white[1, 2]) >= 10).all()
    assert (np.abs(white[0, 0]) < 10).all()
    assert np.isfinite(loss(white)).all()


def test_the_loss_is_a_square_near_zero_and_a_line_far_out() -> None:
    small, large = np.full((1, 4), 1e-3), np.array([[1e4]])
    assert loss(small)[0] == pytest.approx((small**2).sum(), rel=1e-6)
    assert loss(2 * large)[0] / loss(large)[0] == pytest.approx(2, rel=1e-3)
    assert loss(large)[0] == pytest.approx(2 * TURN * large[0, 0], rel=1e-3)
    x = np.linspace(-20, 20, 401)[:, None]
    values = loss(x)
    assert (values >= 0).all()
    assert (values <= x[:, 0] ** 2 + 1e-12).all()
    assert (np.diff(values, 2) > 0).all()  # convex: one minimum
    np.testing.assert_allclose(values, values[::-1])


def test_the_weight_is_the_losss_own_slope() -> None:
    """Reweighted least squares has the loss's gradient: d loss / dx = 2 w^2 x."""
    x = np.linspace(-15, 15, 61)[:, None]
    slope = (loss(x + 1e-5) - loss(x - 1e-5)) / 2e-5
    np.testing.assert_allclose(2 * loss_weight(x)[:, 0] ** 2 * x[:, 0], slope, atol=1e-6)


def test_unexplained_variance_is_what_the_noise_leaves() -> None:
    """Group a carries 9 times the noise's variance, group b none more; far-off and masked blocks buy no slack."""
    rng, blocks = np.random.default_rng(2), 20_000
    mask = np.ones((blocks, 2), bool)
    mask[:500] = False
    problem = Plain(mask)
    sigma = np.broadcast_to(np.diag([0.25, 4.0]), (blocks, 2, 2))
    residual = rng.normal(size=(blocks, 2)) * [0.5 * np.sqrt(10), 2.0]
    residual[:500] = 1e6
    residual[500:600] *= 100
    residual[600] = np.nan
    extra = unexplained_variance(problem, residual, sigma)
    assert extra[0] == pytest.approx(9 * 0.25, rel=0.1)
    assert extra[1] < 0.1 * 4.0  # their plain variance would be 50 times as much
    np.testing.assert_array_equal(unexplained_variance(problem, 0.1 * residual * mask, sigma)[1], 0)


@pytest.mark.parametrize("rough", [False, True])
def test_noise_that_differs_from_block_to_block_buys_no_slack(rough: bool) -> None:
    """Blocks of 0.1 to 10 deviations, all as they are expected: their mean square is ten times the middle one's."""
    rng, blocks = np.random.default_rng(6), 4000
    problem = Plain(np.ones((blocks, 2), bool))
    problem.rough = rough
    deviations = 10 ** rng.uniform(-1, 1, (blocks, 1)) * [1, 3]
    sigma = deviations[:, :, None] ** 2 * np.eye(2)
    residual = deviations * rng.normal(size=(blocks, 2))
    assert (unexplained_variance(problem, residual, sigma) < 0.05 * np.median(deviations**2, 0)).all()
    more = residual + rng.normal(size=(blocks, 2)) * [2.0, 6.0]
    if not rough:
        np.testing.assert_allclose(unexplained_variance(problem, more, sigma), [4, 36], rtol=0.15)


def test_what_one_metric_whitened_is_seen_by_another() -> None:
    problem, rng = Plain(np.ones((SIZE, WIDTH), bool)), np.random.default_rng(2)
    one, other = metric(problem, covariance()), metric(problem, covariance(), np.arange(1.0, WIDTH + 1))
    residual = rng.normal(size=(1, SIZE, WIDTH))
    seen = other.translated(one.whiten(residual)[0][..., None], one)[..., 0]
    np.testing.assert_allclose(seen, other.whiten(residual)[0], rtol=1e-9)


def test_a_model_that_errs_less_is_the_likelier_though_it_expects_less_noise() -> None:
    """Noise that goes the same way in both columns; errors of its size across that way, of which no column tells."""
    rng, blocks = np.random.default_rng(3), 4000
    problem = Plain(np.ones((blocks, 2), bool))
    along = np.ones((2, 2)) + 1e-8 * np.eye(2)

    def surprise(noise: float, error: float, slack: Callable = likeliest_slack) -> float:
        sigma = np.broadcast_to(noise**2 * along, (blocks, 2, 2))
        residual = error * rng.normal(size=(blocks, 1)) * [1, -1] + 1e-4 * noise * rng.normal(size=(blocks, 1))
        return float(metric(problem, sigma, slack(problem, residual, sigma)).surprise(residual[None]).sum())

    worse, better, right = (2.0, 4.0), (1.0, 0.9), (1.0, 0.0)
    assert surprise(*worse) > surprise(*better) + blocks
    assert surprise(*better) > surprise(*right) + blocks
    # Column by column nothing is missing in the better one, whose errors are then beyond belief.
    assert surprise(*worse, slack=unexplained_variance) < surprise(*better, slack=unexplained_variance) - blocks


def test_slack_is_least_where_the_noise_explains_the_errors() -> None:
    rng, blocks = np.random.default_rng(5), 4000
    problem, sigma = Plain(np.ones((blocks, 2), bool)), np.array([[1.0, 0.6], [0.6, 1.0]])
    residual = rng.multivariate_normal(np.zeros(2), sigma, blocks)
    extra = likeliest_slack(problem, residual, np.broadcast_to(sigma, (blocks, 2, 2)))
    assert (extra < 0.05).all()
