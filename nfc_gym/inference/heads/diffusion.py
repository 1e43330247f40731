"""The variance-preserving diffusion with a cosine schedule, as rotations by an angle.

At diffusion time k in [0, 1] the angle is phi = pi k / 2, and x_phi = cos(phi) x + sin(phi) noise (Nichol and Dhariwal
2021; Salimans and Ho 2022). A network predicts v = cos(phi) noise - sin(phi) x, which is d x_phi / d phi: the
probability-flow ODE of Song et al. 2021 is dx / dphi = E[v | x_phi] =: v(x, phi). What follows from it:
    x = cos(phi) x_phi - sin(phi) v      noise = sin(phi) x_phi + cos(phi) v      score = -x_phi - v / tan(phi)
For x ~ N(0, I), v is 0: a network that starts at 0 starts at the prior, exactly.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np
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
    """(steps + 1,) from pi / 2 down to `FLOOR`, their cube roots evenly spaced, as noise in Karras et al. 2022 is.

    They are denser towards the end, where narrow posteriors take shape. Of the type and on the device of `like`, and
    made there.

    Raises:
      InputError: no step at all, which would give noise for an answer.
    """
    require_whole("steps", steps, 1)
    most, least = (x ** (1 / 3) for x in (MOST, FLOOR))
    return torch.linspace(most, least, steps + 1, dtype=torch.float64, device=like.device).pow(3).to(like.dtype)


def clean(x: Tensor, v: Tensor, phi: Tensor) -> Tensor:
    """The mean of the clean x given x_phi."""
    return phi.cos() * x - phi.sin() * v


@lru_cache(maxsize=512)  # solving takes longer than adding up what few draws there are
def weights(nodes: tuple[float, ...], at: float, to: float) -> tuple[float, ...]:
    """Of a rate at one to three angles, so that their sum is its integral from `at` to `to`.

    It is exact for as many of sin, cos and 1 as there are nodes. Where the clean x is known v is -sin times it, plus
    cos times the noise: the sine keeps means exact, whatever the steps, and the cosine noise that has not faded.
    """
    values = np.stack([np.sin(nodes), np.cos(nodes), np.ones(len(nodes))])
    integrals = np.array([math.cos(at) - math.cos(to), math.sin(to) - math.sin(at), to - at])
    return tuple(np.linalg.solve(values[: len(nodes)], integrals[: len(nodes)]).tolist())


def integrate(rate: Field, x: Tensor, grid: Sequence[float]) -> Tensor:
    """Solve dx / dphi = rate(x, phi) along a grid of angles by Adams' methods: each step is predicted and corrected.

    `weights` of the last two rates predict; with the rate found there those of all three correct it, and that rate is
    the next step's first: one evaluation a step. The last step stays as predicted (Zhao et al. 2023, "UniPC"), for at
    `FLOOR` its correction is worth less than a step more. In ten, draws of Gaussians of 0.3, 0.1 and 0.03 of the
    prior's spread come out 0.2, 2 and 6 % too wide and those of 0.01 4 % too narrow, with exact means; of mixtures of
    two they are beside those of many steps by 0.3 to 1.7 % of the posterior's spread.
    """
    ahead, rates = x, list[Tensor]()  # the latest first
    for i, (at, to) in enumerate(pairwise(grid)):
        nodes = tuple(grid[max(i - 2, 0) : i + 1][::-1])
        rates = [rate(ahead, i), *rates[:2]]
        if i:
            x = _moved(x, rates, weights(nodes, nodes[1], at))
        ahead = _moved(x, rates[:2], weights(nodes[:2], at, to))
    return ahead


def _moved(x: Tensor, rates: Sequence[Tensor], by: Sequence[float]) -> Tensor:
    for rate, weight in zip(rates, by, strict=True):
        x = torch.add(x, rate, alpha=weight)
    return x


def flow(field_on: On, noise: Tensor, steps: int = 10) -> Tensor:
    """Noise to samples by the probability-flow ODE, an evaluation a step; noise of `FLOOR` is left in them."""
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
