"""The diffusion's mathematics, on a Gaussian, of which everything is known."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from nfc_gym.inference.heads import diffusion

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


def test_the_ode_transports_the_prior_to_the_gaussian_with_second_order() -> None:
    start = torch.randn(4000, 3, dtype=torch.float64)
    exact = MEAN + SPREAD * start  # the map of two Gaussians with diagonal covariances
    errors = [float((ode_end(n, start) - exact).abs().mean()) for n in (20, 40, 80)]
    assert errors[0] < 0.005
    orders = [math.log2(a / b) for a, b in pairwise(errors)]
    assert min(orders) > 1.8, (errors, orders)


def test_the_reverse_sde_draws_the_gaussian() -> None:
    x = diffusion.reverse_sde(field, torch.randn(20000, 3, dtype=torch.float64), 200)
    np.testing.assert_allclose(x.mean(0), MEAN, atol=0.02)
    np.testing.assert_allclose(x.std(0), SPREAD, rtol=0.03)


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


def test_v_and_its_relations() -> None:
    phi = torch.tensor(0.4, dtype=torch.float64)
    x, noise = torch.randn(5, 3, dtype=torch.float64), torch.randn(5, 3, dtype=torch.float64)
    at, v = phi.cos() * x + phi.sin() * noise, phi.cos() * noise - phi.sin() * x
    torch.testing.assert_close(diffusion.clean(at, v, phi), x)
    grid = diffusion.angles(10, phi)
    assert grid[0] == pytest.approx(math.pi / 2)
    assert grid[-1] == pytest.approx(diffusion.FLOOR)
    assert (grid.diff() < 0).all()
