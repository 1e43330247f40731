"""The diffusion's mathematics, on a Gaussian, of which everything is known."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from nfc_gym.inference.heads import diffusion
from nfc_gym.inference.heads.score import time_features

MEAN, SPREAD = torch.tensor([0.7, -1.2, 0.0], dtype=torch.float64), torch.tensor([0.1, 0.5, 1.0], dtype=torch.float64)


def field(grid: Tensor) -> diffusion.Field:
    """v of x ~ N(MEAN, SPREAD^2): E[x | x_phi] by the Gaussian's conditional mean."""

    def v(x: Tensor, i: int) -> Tensor:
        c, s = grid[i].cos(), grid[i].sin()
        variance = (c * SPREAD).square() + s.square()
        clean = MEAN + c * SPREAD.square() / variance * (x - c * MEAN)
        noise = (x - c * clean) / s
        return c * noise - s * clean

    return v


def ode_end(steps: int, start: Tensor) -> Tensor:
    return diffusion.flow(field, start, steps)


def test_the_ode_transports_the_prior_to_the_gaussian_with_third_order() -> None:
    start = torch.randn(4000, 3, dtype=torch.float64)
    # The map of two Gaussians with diagonal covariances, up to the least angle, where noise of its size is left.
    least = torch.tensor(diffusion.FLOOR, dtype=torch.float64)
    exact = least.cos() * MEAN + ((least.cos() * SPREAD).square() + least.sin().square()).sqrt() * start
    errors = [float((ode_end(n, start) - exact).abs().mean()) for n in (20, 40, 80)]
    assert errors[0] < 0.0003
    orders = [math.log2(a / b) for a, b in pairwise(errors)]
    assert min(orders) > 2.5, (errors, orders)


def test_the_usual_steps_draw_neither_too_narrow_nor_beside() -> None:
    """A solver that lags makes every posterior too sure, and its intervals hold the truth less often than they say."""
    ends = torch.tensor([[-2.0], [0.0], [2.0]], dtype=torch.float64).expand(3, 3)  # the map is linear
    low, middle, high = diffusion.flow(field, ends)
    wider = (high - low) / 4 / SPREAD - 1
    assert (wider.abs() <= torch.tensor([0.025, 0.0015, 1e-12])).all(), wider
    torch.testing.assert_close(middle, math.cos(diffusion.FLOOR) * MEAN, atol=1e-12, rtol=0)


@pytest.mark.parametrize(("at", "spread", "most"), [(0.5, 0.2, 0.005), (0.1, 0.03, 0.019), (1.0, 0.1, 0.012)])
def test_the_usual_steps_draw_two_modes(at: float, spread: float, most: float) -> None:
    """Root mean square error of a draw, in the posterior's spread: at -at and at, each of `spread`."""

    def modes(grid: Tensor) -> diffusion.Field:
        def v(x: Tensor, i: int) -> Tensor:
            c, s = grid[i].cos(), grid[i].sin()
            variance = (c * spread).square() + s.square()
            middle = at * (c * at * x / variance).tanh()
            clean = middle + c * spread**2 / variance * (x - c * middle)
            return c * (x - c * clean) / s - s * clean

        return v

    noise = math.sqrt(2) * torch.linspace(-1, 1, 1001, dtype=torch.float64)[1:-1].erfinv()
    wrong = (diffusion.flow(modes, noise) - diffusion.flow(modes, noise, 200)).square().mean().sqrt()
    assert wrong < most * math.hypot(at, spread)


@pytest.mark.parametrize("nodes", [(1.2,), (0.3, 0.9), (0.002, 0.01, 0.5), (1e-3, 1.1e-3, 1.3e-3)])
def test_weights_integrate_sines_cosines_and_constants(nodes: tuple[float, ...]) -> None:
    at, to = 0.8, 0.1
    exact = [math.cos(at) - math.cos(to), math.sin(to) - math.sin(at), to - at]
    values = np.stack([np.sin(nodes), np.cos(nodes), np.ones(len(nodes))])[: len(nodes)]
    np.testing.assert_allclose(values @ diffusion.weights(nodes, at, to), exact[: len(nodes)], atol=1e-9)


def test_each_step_asks_the_field_once() -> None:
    asked: list[int] = []

    def counted(grid: Tensor) -> diffusion.Field:
        v = field(grid)
        return lambda x, i: (asked.append(i), v(x, i))[1]

    diffusion.flow(counted, torch.zeros(1, 3, dtype=torch.float64), 7)
    assert asked == list(range(7))


def test_the_reverse_sde_draws_the_gaussian() -> None:
    """In the usual steps, ten times those of the ODE; a standard deviation of 100,000 draws is off by 0.2 %."""
    for kind in (torch.float64, torch.float32):
        x = diffusion.reverse_sde(field, torch.randn(100_000, 3, dtype=kind), 100).double()
        np.testing.assert_allclose(x.mean(0), MEAN, atol=0.01)
        np.testing.assert_allclose(x.std(0), SPREAD, rtol=0.01)


def test_the_density_is_the_gaussians() -> None:
    x = MEAN + SPREAD * torch.randn(60, 3, dtype=torch.float64)
    exact = torch.distributions.Normal(MEAN, SPREAD).log_prob(x).sum(-1)
    errors = [float((diffusion.log_density(field, x, n) - exact).abs().mean()) for n in (6, 12, 16)]
    assert errors[0] / errors[1] > 8  # fourth order
    assert errors[2] < 1e-3


def test_no_field_is_the_prior_exactly() -> None:
    x = torch.randn(50, 4)

    def nothing(grid: Tensor) -> diffusion.Field:
        return lambda y, i: torch.zeros_like(y)

    prior = torch.distributions.Normal(0, 1).log_prob(x).sum(-1)
    torch.testing.assert_close(diffusion.log_density(nothing, x, 5), prior)
    torch.testing.assert_close(diffusion.flow(nothing, x, 5), x)


def test_the_divergence_is_exact() -> None:
    torch.manual_seed(1)
    a = torch.randn(4, 4, dtype=torch.float64)
    x = torch.randn(7, 2, 4, dtype=torch.float64)
    v, div = diffusion.divergence(lambda y: torch.tanh(y @ a.T), x)
    torch.testing.assert_close(v, torch.tanh(x @ a.T))
    expected = ((1 - torch.tanh(x @ a.T).square()) * a.diagonal()).sum(-1)
    torch.testing.assert_close(div, expected)


def test_a_network_is_told_of_the_noisiest_angle_as_of_those_before_it() -> None:
    """float32 rounds pi / 2 up, where the tangent is negative: as if no noise were left where every draw begins."""
    single, double = (
        time_features(torch.tensor([math.pi / 2], dtype=t)).double() for t in (torch.float32, torch.float64)
    )
    torch.testing.assert_close(single, double, atol=1e-4, rtol=0)
    before = time_features(torch.tensor([math.pi / 2 - 0.005], dtype=torch.float64))
    assert (double - before).abs().max() < 0.7  # the fastest wave of the angle turns by 0.64 in that step
    ratio = torch.tensor([8, 9, 10, 11, 12, 13, 14, 15])  # waves of the ratio: it stays where it was
    torch.testing.assert_close(double[:, ratio], before[:, ratio])


def test_v_and_its_relations() -> None:
    phi = torch.tensor(0.4, dtype=torch.float64)
    x, noise = torch.randn(5, 3, dtype=torch.float64), torch.randn(5, 3, dtype=torch.float64)
    at, v = phi.cos() * x + phi.sin() * noise, phi.cos() * noise - phi.sin() * x
    torch.testing.assert_close(diffusion.clean(at, v, phi), x)
    grid = diffusion.angles(10, phi)
    assert grid[0] == pytest.approx(math.pi / 2)
    assert grid[-1] == pytest.approx(diffusion.FLOOR)
    assert (grid.diff() < 0).all()
