"""What a window can tell of psi at most, by the Fisher information of its noisy states.

With the start state and the actions known, the states y of a window are f(u, e) + noise: u is psi in its box, [0, 1],
and e what the motors made of the actions, which nobody saw. Taken as linear in both, they tell of u the information

    I = J' (R + C)^-1 J,    J = d E[f] / du,    C = cov_e f,

R being the noise's covariance. J is by central differences of the simulator with the same e on both sides, averaged
over `pairs` of draws; C is that of a `cloud` of draws. So that the noise of J does not look like information, two
halves of the draws are multiplied crosswise and negative eigenvalues cut off. A cloud that is too small leaves
directions uncovered: the ceiling then is too high, never too low.

Under the uniform prior each parameter is then a number in [0, 1] seen through Gaussian noise of standard deviation
sigma = (I_ii - I_io (I_oo + 12)^-1 I_oi)^-1/2: the others, o, of variance 1/12 beforehand, are marginalised. Its
expected posterior variance and the information gained have no closed form, but are integrals in one dimension
(`variance`, `gain`). For the joint gain the same is done along the chain rule, each parameter given those before it.

It is a ceiling in so far as start, actions and noise are known exactly and f is nearly linear over a posterior's width:
what an estimator gains beyond it is a fault of one of the two. Parameters that leave the states alone have gain 0 and
the prior's variance, 1/12.
"""

from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from nfc_gym.core.errors import InputError

Array = NDArray[np.float64]
Simulator = Callable[[Array, NDArray[np.intp]], Array]  # (u (m, d), draw of e (m,)) -> outputs (m, k)
PRIOR = 12.0  # one over the variance of a uniform number in [0, 1]
STEP = 0.05  # of u: large beside the chatter of contacts, small beside the box
_LEAST, _MOST = 1e-4, 1e3  # of sigma: beyond these the limits hold to all digits that matter


class Ceiling(NamedTuple):
    """What n windows can tell of d parameters at most.

    Attributes:
      information: (n, d, d) Fisher information on u; entries of windows that a step of psi makes unstable are nan.
      variance: (n, d) expected posterior variance of u at least, between 0 and 1/12.
      gain: (n, d) information gained of each parameter by itself at most, nats.
      joint: (n,) of all together, nats; it counts correlations that `gain` cannot.
    """

    information: Array
    variance: Array
    gain: Array
    joint: Array


def information(
    simulator: Simulator, u: Array, noise: Array, step: float = STEP, cloud: int = 0, pairs: int = 1
) -> Array:
    """Fisher information (d, d) of outputs under Gaussian noise of sensors and motors, by differences.

    Args:
      simulator: outputs (m, k) at u (m, d); equal draws are equal motors' noise.
      u: (d,) in [0, 1], where to linearise; within a step of the box's edge the point is moved inwards.
      noise: (k,) standard deviation of each output; 0 leaves it out, it is known without measuring.
      step: of u.
      cloud: draws of the motors' noise that their covariance is taken from; 0 where there is none.
      pairs: further draws that slopes are averaged over; an even number, or 1 where there is no noise of motors.

    Raises:
      InputError: no output with noise, outputs of another shape, or an odd number of pairs with a cloud.
    """
    told, d = np.asarray(noise) > 0, len(u)
    if not told.any():
        raise InputError("the ceiling needs outputs with measurement noise; all of these are known exactly")
    if cloud and (pairs < 2 or pairs % 2):
        raise InputError(f"pairs is {pairs}; want an even number, as two halves are compared")
    middle = np.clip(u, step, 1 - step)
    moves = step * np.concatenate([np.eye(d), -np.eye(d)])
    at = np.concatenate([np.tile(middle, (cloud, 1)), np.repeat(middle + moves, pairs, 0)])
    out = simulator(at, np.concatenate([np.arange(cloud), cloud + np.tile(np.arange(pairs), 2 * d)]))
    if out.shape != (len(at), len(told)):
        raise InputError(f"the simulator gives outputs {out.shape}, want {(len(at), len(told))}")
    white = out[:, told] / np.asarray(noise)[told]
    ends = white[cloud:].reshape(2, d, pairs, -1)
    slope = (ends[0] - ends[1]) / (2 * step)
    if not cloud:
        mean = slope.mean(1)
        return mean @ mean.T
    one, other = slope[:, ::2].mean(1), slope[:, 1::2].mean(1)
    spread = (white[:cloud] - white[:cloud].mean(0)) / np.sqrt(max(cloud - 1, 1))
    return _positive(_within(one, other, spread))


def _within(one: Array, other: Array, spread: Array) -> Array:
    """one (1 + spread' spread)^-1 other', for few rows of spread (c, k), by Woodbury's identity."""
    a, b = one @ spread.T, other @ spread.T
    return one @ other.T - a @ np.linalg.solve(np.eye(len(spread)) + spread @ spread.T, b.T)


def _positive(matrix: Array) -> Array:
    """The nearest symmetric matrix without negative eigenvalues; nan stays nan."""
    if not np.isfinite(matrix).all():
        return np.full_like(matrix, np.nan)
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return (vectors * np.maximum(values, 0)) @ vectors.T


def bounds(information: Array) -> Ceiling:
    """Variance, gain and joint gain from Fisher information (n, d, d)."""
    n, d = information.shape[:2]
    own, chain = np.empty((n, d)), np.empty((n, d))
    for i in range(d):
        own[:, i] = _told(information, i, [j for j in range(d) if j != i])
        chain[:, i] = _told(information, i, list(range(i + 1, d)))
    return Ceiling(information, variance(own), gain(own), gain(chain).sum(1))


def _told(information: Array, i: int, others: list[int]) -> Array:
    """(n,) standard deviation of the noise through which parameter i is seen, the others being uncertain."""
    left = information[:, i, i].copy()
    if others:
        cross = information[:, others, i]
        among = information[:, others][:, :, others] + PRIOR * np.eye(len(others))
        ok = np.isfinite(among).all((1, 2))
        left[ok] -= np.einsum("ni,ni->n", cross[ok], np.linalg.solve(among[ok], cross[ok][..., None])[..., 0])
    return 1 / np.sqrt(np.maximum(left, 1 / _MOST**2))


def variance(sigma: Array) -> Array:
    """Expected posterior variance of a uniform number in [0, 1] that is seen through Gaussian noise of sd `sigma`."""
    return _interpolated(sigma)[0]


def gain(sigma: Array) -> Array:
    """Information, nats, that such an observation gives: h(y) - h(y | u)."""
    return _interpolated(sigma)[1]


def _interpolated(sigma: Array) -> tuple[Array, Array]:
    x, log_variance, gained = _table()
    at = np.log(np.clip(sigma, _LEAST, _MOST))
    return np.exp(np.interp(at, x, log_variance)), np.interp(at, x, gained)


@cache
def _panel() -> tuple[Array, Array]:
    """Nodes in [-1, 1] and weights of a panel's quadrature; to find them takes longer than to use them."""
    return np.polynomial.legendre.leggauss(80)


@cache
def _table() -> tuple[Array, Array, Array]:
    """log sigma -> log of the expected variance, and the gain, by quadrature over what is observed."""
    x = np.linspace(np.log(_LEAST), np.log(_MOST), 1201)
    rows = [_exact(float(np.exp(s))) for s in x]
    return x, np.log([v for v, _ in rows]), np.array([g for _, g in rows])


def _exact(sigma: float) -> tuple[float, float]:
    """For y = u + sigma e: y has the density ndtr(y / sigma) - ndtr((y - 1) / sigma), u given y is a cut-off normal."""
    # Panels: the two edges, where the density bends within a few sigma, and the middle, where nothing changes.
    reach = 8 * sigma
    cuts = [-reach, 0.0, min(reach, 0.5), max(1 - reach, 0.5), 1.0, 1 + reach]
    node, weight = _panel()
    y = np.concatenate([(a + b) / 2 + (b - a) / 2 * node for a, b in pairwise(cuts)])
    w = np.concatenate([(b - a) / 2 * weight for a, b in pairwise(cuts)])
    # Seen from the nearer half, both edges are to the left in the tail that ndtr resolves.
    low, high = -y / sigma, (1 - y) / sigma
    mass = np.where(low > 0, ndtr(-low) - ndtr(-high), ndtr(high) - ndtr(low))
    keep = mass > 1e-300
    low, high, mass, w = low[keep], high[keep], mass[keep], w[keep]
    bell = lambda z: np.exp(-z * z / 2) / np.sqrt(2 * np.pi)  # noqa: E731
    mean = (bell(low) - bell(high)) / mass
    spread = 1 + (low * bell(low) - high * bell(high)) / mass - mean * mean
    entropy = -(w * mass * np.log(mass)).sum()
    gained = entropy - np.log(sigma) - 0.5 * np.log(2 * np.pi * np.e)
    return float(min((w * mass * spread).sum() * sigma**2, 1 / PRIOR)), float(max(gained, 0.0))
