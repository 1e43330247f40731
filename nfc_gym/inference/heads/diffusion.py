"""The variance-preserving diffusion with a cosine schedule, as rotations by an angle.

At diffusion time k in [0, 1] the angle is phi = pi k / 2, and x_phi = cos(phi) x + sin(phi) noise (Nichol and Dhariwal
2021; Salimans and Ho 2022). A network predicts v = cos(phi) noise - sin(phi) x, which is d x_phi / d phi: the
probability-flow ODE of Song et al. 2021 is dx / dphi = E[v | x_phi] =: v(x, phi). What follows from it:
    x = cos(phi) x_phi - sin(phi) v      noise = sin(phi) x_phi + cos(phi) v      score = -x_phi - v / tan(phi)
For x ~ N(0, I), v is 0: a network that starts at 0 starts at the prior, exactly.
"""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from nfc_gym.core.whole import require_whole

Field = Callable[[Tensor, int], Tensor]  # (x, i) -> v of x's shape at the i-th angle of a grid
On = Callable[
    [Tensor], Field
]  # a grid of angles (n,) -> the field on it; what depends on angles alone is computed once
FLOOR = 2e-3  # smallest angle: detail of that size of the prior's spread is left as it is
MOST = math.pi / 2
_FADED = 1e-30  # of what a step from pi / 2 leaves of x, where the cosine is rounded to either side of 0


def angles(steps: int, like: Tensor) -> Tensor:
    """(steps + 1,) from pi / 2 down to `FLOOR`, denser towards the end, where narrow posteriors take shape.

    Of the type and on the device of `like`, and made there.

    Raises:
      InputError: no step at all, which would give noise for an answer.
    """
    require_whole("steps", steps, 1)
    even = torch.linspace(1, 0, steps + 1, dtype=torch.float64, device=like.device)
    return (FLOOR + (MOST - FLOOR) * even.pow(3)).to(like.dtype)


def clean(x: Tensor, v: Tensor, phi: Tensor) -> Tensor:
    """The mean of the clean x given x_phi."""
    return phi.cos() * x - phi.sin() * v


def integrate(rate: Field, x: Tensor, grid: Sequence[float]) -> Tensor:
    """Solve dx / dphi = rate(x, phi) along a grid of angles by Adams' methods: each step is predicted and corrected.

    The explicit step of second order predicts; with the rate found there the implicit one of third order corrects it,
    and that rate is the next step's first: one evaluation a step, and one at the start. Without the correction, draws
    of a Gaussian came out 4 % too narrow at half the prior's spread and 10 % at a tenth of it, in 13 evaluations; with
    it they are 0.3 % and 3 % too wide.
    """
    before: tuple[float, Tensor] | None = None
    now = rate(x, 0)
    for i, (at, to) in enumerate(pairwise(grid), 1):
        step = to - at
        if before is None:  # Euler's method and the trapezoid
            after = rate(torch.add(x, now, alpha=step), i)
            x = torch.add(x, now + after, alpha=step / 2)
        else:
            last, past = before
            ratio = step / last
            ahead = torch.add(torch.add(x, now, alpha=step * (1 + ratio / 2)), past, alpha=-step * ratio / 2)
            after = rate(ahead, i)
            x = torch.add(x, after, alpha=step * (3 + 2 * ratio) / (6 * (1 + ratio)))
            x = torch.add(x, now, alpha=step * (3 + ratio) / 6)
            x = torch.add(x, past, alpha=-step * ratio**2 / (6 * (1 + ratio)))
        before, now = (step, now), after
    return x


def flow(field_on: On, noise: Tensor, steps: int = 12) -> Tensor:
    """Noise to samples by the probability-flow ODE, in steps + 1 evaluations; noise of `FLOOR` is left in them."""
    return integrate(field_on(angles(steps, noise)), noise, angles(steps, noise.new_empty(0, device="cpu")).tolist())


def reverse_sde(field_on: On, noise: Tensor, steps: int = 150) -> Tensor:
    """Noise to samples by the reverse SDE, in its exact transitions given the mean of the clean x (Ho et al. 2020).

    From angle a to b, with fade = tan(b) / tan(a), x becomes
        sin(b) / sin(a) fade x + cos(b) (1 - fade^2) clean + sin(b) sqrt(1 - fade^2) noise.
    The clean x is what the last two say of the step's middle in log tan (Lu et al. 2022, "DPM-Solver++"): as it was at
    the step's beginning, draws of Gaussians came out 2 to 5 % too narrow.
    """
    x, before = noise, None
    grid = angles(steps, noise)
    field = field_on(grid)
    for i, (a, b) in enumerate(pairwise(grid)):
        now = clean(x, field(x, i), a)
        fade = (b.sin() * a.cos() / (b.cos() * a.sin())).clamp(min=_FADED)
        step, left = -fade.log(), 1 - fade.square()
        middle = now if before is None else now + step / before[0] / 2 * (now - before[1])
        x = b.sin() / a.sin() * fade * x + b.cos() * left * middle + b.sin() * left.sqrt() * torch.randn_like(x)
        before = step, now
    return clean(x, field(x, steps), grid[-1])


def log_density(field_on: On, x: Tensor, steps: int = 16) -> Tensor:
    """(...,) log density of x (..., d) by the same ODE run backwards, with the exact trace of dv / dx.

    log p(x) = log N(x_end) + integral of div v dphi (Song et al. 2021, equation 39), by Runge and Kutta's method of
    fourth order: a bias here would be one of every density reported, so it is held to a hundredth of a nat.
    """
    ends = angles(steps, x.new_empty((), dtype=torch.float64)).flip(0)
    middles = (ends[:-1] + ends[1:]) / 2
    grid = torch.cat([ends, middles]).sort().values.to(x.dtype)  # the odd ones are middles
    field = field_on(grid)

    def rate(both: Tensor, i: int) -> Tensor:
        v, trace = divergence(lambda y: field(y, i), both[..., :-1])
        return torch.cat([v, trace[..., None]], -1)

    end = nn.functional.pad(x, (0, 1))
    for i in range(0, 2 * steps, 2):
        step = grid[i + 2] - grid[i]
        k1 = rate(end, i)
        k2 = rate(end + step / 2 * k1, i + 1)
        k3 = rate(end + step / 2 * k2, i + 1)
        end = end + step / 6 * (k1 + 2 * k2 + 2 * k3 + rate(end + step * k3, i + 2))
    return end[..., -1] - (end[..., :-1].square() + math.log(2 * math.pi)).sum(-1) / 2


def divergence(field: Callable[[Tensor], Tensor], x: Tensor) -> tuple[Tensor, Tensor]:
    """v and its exact divergence (...,): forward derivatives along each axis, all axes and points in one batch."""
    axes = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)

    def along(axis: Tensor) -> tuple[Tensor, Tensor]:
        v, dv = torch.func.jvp(field, (x,), (axis.expand_as(x),))  # type: ignore[misc] (no auxiliary output)
        return v, (dv * axis).sum(-1)

    v, parts = torch.func.vmap(along)(axes)
    return v[0], parts.sum(0)
