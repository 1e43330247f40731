"""Simulators whose posterior is known in closed form, or can be sampled exactly.

Two moons and SLCP are those of the simulation-based inference benchmark (Lueckmann et al. 2021, appendix T),
written from its description. Each task says psi's box, simulates, and draws from the posterior of an observation.
"""

from itertools import combinations
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import multivariate_normal

from nfc_gym.core.errors import InputError
from nfc_gym.envs.mirror import Mirror, Signed
from nfc_gym.inference.space import PriorBox

Array = NDArray[np.float64]


class Task(Protocol):
    """One known problem.

    Attributes:
      name: of the problem.
      box: of psi.
      mirrors: in each of which a simulation is another one that is as likely, as those of robots are.
    """

    name: str
    box: PriorBox
    mirrors: tuple[Mirror, ...]

    def simulate(self, psi: Array, rng: np.random.Generator) -> Array:
        """Observations (n, k) of psi (n, d)."""
        ...

    def posterior(self, x: Array, n: int, rng: np.random.Generator) -> Array:
        """(n, d) exact draws of psi given one observation (k,)."""
        ...


def box(name: str, size: int, low: float, high: float) -> PriorBox:
    """A cube."""
    return PriorBox(name, tuple(f"p{i}" for i in range(size)), ("1",) * size, (low,) * size, (high,) * size)


class LinearGaussian:
    """x = A z + 0.5 noise, z = probit(u): the posterior of z is Gaussian; A is a rotation with gains of 0.5 to 2.

    Args:
      size: of psi and of x.
    """

    noise, mirrors = 0.5, ()

    def __init__(self, size: int) -> None:
        self.name, self.box = f"linear_gaussian_{size}", box(f"linear_gaussian_{size}", size, 0.0, 1.0)
        turn, _ = np.linalg.qr(np.random.default_rng(size).normal(size=(size, size)))
        self.mix = turn * np.geomspace(0.5, 2.0, size)
        self.covariance = np.linalg.inv(np.eye(size) + self.mix.T @ self.mix / self.noise**2)

    def simulate(self, psi: Array, rng: np.random.Generator) -> Array:
        """See `Task`."""
        z = ndtri(psi)
        return z @ self.mix.T + self.noise * rng.normal(size=z.shape)

    def gaussian(self, x: Array) -> multivariate_normal:
        """The posterior of z."""
        return multivariate_normal(self.covariance @ self.mix.T @ x / self.noise**2, self.covariance)

    def posterior(self, x: Array, n: int, rng: np.random.Generator) -> Array:
        """See `Task`."""
        return self.box.from_z(self.gaussian(x).rvs(n, random_state=rng))

    def log_prob(self, psi: Array, x: Array) -> Array:
        """(n,) log density of psi in its own units: that of z over the prior's, the box having volume 1."""
        z = self.box.to_z(psi)
        return self.gaussian(x).logpdf(z) + (z**2 + np.log(2 * np.pi)).sum(1) / 2


class TwoMoons:
    """Two crescents: x = crescent + (-|p0 + p1|, -p0 + p1) / sqrt(2), p uniform on [-1, 1]^2.

    Given the sign of p0 + p1, psi is a rotation of crescent - x: exact draws need no chain.
    """

    name, box, mirrors = "two_moons", box("two_moons", 2, -1.0, 1.0), ()

    @staticmethod
    def crescent(n: int, rng: np.random.Generator) -> Array:
        """(n, 2) points."""
        angle, radius = rng.uniform(-np.pi / 2, np.pi / 2, n), rng.normal(0.1, 0.01, n)
        return np.stack([radius * np.cos(angle) + 0.25, radius * np.sin(angle)], 1)

    def simulate(self, psi: Array, rng: np.random.Generator) -> Array:
        """See `Task`."""
        away = np.stack([-np.abs(psi.sum(1)), psi[:, 1] - psi[:, 0]], 1) / np.sqrt(2)
        return self.crescent(len(psi), rng) + away

    def posterior(self, x: Array, n: int, rng: np.random.Generator) -> Array:
        """See `Task`."""
        found: list[Array] = []
        while sum(map(len, found)) < n:
            away = self.crescent(4 * n, rng) - x
            total = away[:, 0] * rng.choice([-1.0, 1.0], 4 * n)  # (p0 + p1) / sqrt(2)
            other = -away[:, 1]  # (p1 - p0) / sqrt(2)
            psi = np.stack([total - other, total + other], 1) / np.sqrt(2)
            found.append(psi[(away[:, 0] >= 0) & (np.abs(psi) <= 1).all(1)])
        return np.concatenate(found)[:n]


def exchanged(first: int, second: int) -> Mirror:
    """What SLCP's observation is after two of its four draws have changed places: psi is as likely as before."""
    order, none = np.arange(8).reshape(4, 2), np.arange(0)
    order[[first, second]] = order[[second, first]]
    return Mirror(Signed(order.ravel(), np.ones(8)), Signed(none, np.ones(0)), np.arange(5))


class SLCP:
    """Simple likelihood, complex posterior: four draws of a Gaussian with mean (p0, p1), spreads p2^2, p3^2, tanh p4.

    p is uniform on [-3, 3]^5; the posterior has four modes. Its draws are prior draws resampled by likelihood, which is
    exact for many of them; p0 and p1 are proposed from their conditional Gaussian, so that three dimensions are left.
    """

    name, box = "slcp", box("slcp", 5, -3.0, 3.0)
    mirrors = tuple(exchanged(i, j) for i, j in combinations(range(4), 2))  # one after another: any order of the four
    _CHUNK, _CHUNKS = 2_000_000, 10

    @staticmethod
    def spread(psi: Array) -> tuple[Array, Array, Array]:
        """Standard deviations (n,), (n,) and the correlation (n,)."""
        return psi[:, 2] ** 2, psi[:, 3] ** 2, np.tanh(psi[:, 4])

    def simulate(self, psi: Array, rng: np.random.Generator) -> Array:
        """See `Task`."""
        a, b, c = self.spread(psi)
        e = rng.normal(size=(len(psi), 4, 2))
        first = psi[:, :1] + a[:, None] * e[..., 0]
        second = psi[:, 1:2] + b[:, None] * (c[:, None] * e[..., 0] + np.sqrt(1 - c**2)[:, None] * e[..., 1])
        return np.stack([first, second], 2).reshape(len(psi), 8)

    def posterior(self, x: Array, n: int, rng: np.random.Generator) -> Array:
        """See `Task`.

        Raises:
          InputError: fewer distinct draws than asked for carry the weight.
        """
        found, weights, top = [], [], -np.inf
        for _ in range(self._CHUNKS):
            psi, weight = self.proposed(x.reshape(4, 2), self._CHUNK, rng)
            top = max(top, weight.max())
            likely = weight > top - 16  # the others' share is below 1e-6
            found.append(psi[likely])
            weights.append(weight[likely])
        psi, weight = np.concatenate(found), np.exp(np.concatenate(weights) - top)
        weight /= weight.sum()
        effective = 1 / (weight**2).sum()
        if effective < n:
            raise InputError(f"slcp: {effective:.0f} effective draws for {n}: take fewer")
        return psi[rng.choice(len(psi), n, p=weight)]

    def proposed(self, points: Array, n: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """(n, 5) draws, p0 and p1 given the rest, and their log weights (n,); minus infinity outside the prior."""
        middle, psi = points.mean(0), rng.uniform(-3, 3, (n, 5))
        a, b, c = self.spread(psi)
        left = np.sqrt(np.maximum(1 - c**2, 1e-12))
        e = rng.normal(size=(n, 2)) / 2  # the mean of four draws has half their spread
        psi[:, 0] = middle[0] + a * e[:, 0]
        psi[:, 1] = middle[1] + b * (c * e[:, 0] + left * e[:, 1])
        square = sum((p / a) ** 2 + ((q / b - c * p / a) / left) ** 2 for p, q in points - middle)
        # integrated over the mean, the scales of three of the four draws remain
        weight = -square / 2 - 3 * np.log(a * b * left)
        return psi, np.where((np.abs(psi[:, :2]) <= 3).all(1), weight, -np.inf)


TASKS: dict[str, tuple[Task, ...]] = {
    "linear_gaussian": (LinearGaussian(5), LinearGaussian(10)),
    "two_moons": (TwoMoons(),),
    "slcp": (SLCP(),),
}
