"""The variance-preserving diffusion with a cosine schedule, as rotations by an angle.

At diffusion time k in [0, 1] the angle is phi = pi k / 2, and x_phi = cos(phi) x + sin(phi) noise (Nichol and Dhariwal
2021; Salimans and Ho 2022). A network predicts v = cos(phi) noise - sin(phi) x, which is d x_phi / d phi: the
probability-flow ODE of Song et al. 2021 is dx / dphi = E[v | x_phi] =: v(x, phi). What follows from it:
    x = cos(phi) x_phi - sin(phi) v      noise = sin(phi) x_phi + cos(phi) v      score = -x_phi - v / tan(phi)
For x ~ N(0, I), v is 0: a network that starts at 0 starts at the prior, exactly.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

Field = Callable[[Tensor, Tensor], Tensor]  # (x, phi as a tensor of no axes) -> v of x's shape
FLOOR = 2e-3  # smallest angle: detail of that size of the prior's spread is left as it is
MOST = math.pi / 2


def angles(steps: int) -> Tensor:
    """(steps + 1,) from pi / 2 down to `FLOOR`, denser towards the end, where narrow posteriors take shape."""
    return FLOOR + (MOST - FLOOR) * torch.linspace(1, 0, steps + 1, dtype=torch.float64).pow(3)


def integrate(rate: Field, x: Tensor, grid: Tensor) -> Tensor:
    """Solve dx / dphi = rate(x, phi) along a grid of angles: Adams and Bashforth's method of second order.

    One evaluation a step, after one step of Heun's method. At 20 evaluations it is two to four times as accurate as
    Heun's method throughout, on Gaussians a tenth to a hundredth as wide as the prior.
    """
    before: tuple[Tensor, Tensor] | None = None
    for a, b in zip(grid[:-1], grid[1:], strict=True):
        step, now = b - a, rate(x, a)
        if before is None:
            x = x + step / 2 * (now + rate(x + step * now, b))
        else:
            last, past = before
            x = x + step * (now + step / last / 2 * (now - past))
        before = step, now
    return x


def clean(x: Tensor, v: Tensor, phi: Tensor) -> Tensor:
    """The mean of the clean x given x_phi."""
    return phi.cos() * x - phi.sin() * v


def flow(field: Field, noise: Tensor, steps: int = 15) -> Tensor:
    """Noise to samples by the probability-flow ODE."""
    grid = angles(steps).to(noise.dtype).to(noise.device)
    x = integrate(field, noise, grid)
    return clean(x, field(x, grid[-1]), grid[-1])


def reverse_sde(field: Field, noise: Tensor, steps: int = 100) -> Tensor:
    """Noise to samples by the reverse SDE, in its exact transitions given the mean of the clean x (Ho et al. 2020)."""
    x = noise
    grid = angles(steps).to(noise.dtype).to(noise.device)
    for a, b in zip(grid[:-1], grid[1:], strict=True):
        v = field(x, a)
        kept = (a.cos() / b.cos()) ** 2  # signal that the forward step from b to a leaves
        fresh = (b.sin() / a.sin()) * (1 - kept).clamp(min=0).sqrt()
        rest = (b.sin().square() - fresh.square()).clamp(min=0).sqrt()
        x = b.cos() * clean(x, v, a) + rest * (a.sin() * x + a.cos() * v) + fresh * torch.randn_like(x)
    return clean(x, field(x, grid[-1]), grid[-1])


def log_density(field: Field, x: Tensor, steps: int = 16) -> Tensor:
    """(...,) log density of x (..., d) by the same ODE run backwards, with the exact trace of dv / dx.

    log p(x) = log N(x_end) + integral of div v dphi (Song et al. 2021, equation 39), by Runge and Kutta's method of fourth
    order: a bias here would be one of every density reported, so it is held a hundredth of a nat small.
    """
    grid = angles(steps).flip(0).to(x.dtype).to(x.device)

    def rate(both: Tensor, phi: Tensor) -> Tensor:
        v, trace = divergence(field, both[..., :-1], phi)
        return torch.cat([v, trace[..., None]], -1)

    end = nn.functional.pad(x, (0, 1))
    for a, b in zip(grid[:-1], grid[1:], strict=True):
        step, middle = b - a, (a + b) / 2
        k1 = rate(end, a)
        k2 = rate(end + step / 2 * k1, middle)
        k3 = rate(end + step / 2 * k2, middle)
        end = end + step / 6 * (k1 + 2 * k2 + 2 * k3 + rate(end + step * k3, b))
    return end[..., -1] - (end[..., :-1].square() + math.log(2 * math.pi)).sum(-1) / 2


def divergence(field: Field, x: Tensor, phi: Tensor) -> tuple[Tensor, Tensor]:
    """v and its exact divergence (...,): forward derivatives along each axis, all axes and points in one batch."""
    axes = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)

    def along(axis: Tensor) -> tuple[Tensor, Tensor]:
        v, dv = torch.func.jvp(lambda y: field(y, phi), (x,), (axis.expand_as(x),))
        return v, (dv * axis).sum(-1)

    v, parts = torch.func.vmap(along, out_dims=(None, 0))(axes)
    return v, parts.sum(0)
