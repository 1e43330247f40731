"""What later rounds simulate: the prior where a posterior has mass, or draws of the posterior itself.

Draws of a posterior teach a network the posterior under another prior than the box. That prior is known, since every
round's proposal has a density, and so is the way back (Papamakarios and Murray 2016); as the first round's windows are
of the box, the correction is bounded (a defensive mixture: Hesterberg 1995), whatever the posterior got wrong.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.core.posterior import without_maps
from nfc_gym.core.whole import require_whole
from nfc_gym.inference.network import Network
from nfc_gym.inference.normal import Normal
from nfc_gym.inference.posterior import NeuralPosterior
from nfc_gym.inference.space import PriorBox

Array = NDArray[np.float64]
TRUNCATED, POSTERIOR = PROPOSALS = ("truncated", "posterior")
QUANTILE = 5e-4  # of the posterior's density, that says how far its draws reach
WIDER = 1.0  # how many times as far truncated proposals do
_FILLS = 1.5  # times the variance of what lies evenly in a region: that of candidates for it
_OWN = 0.25  # of such candidates: draws of the posterior itself
_NARROWS = 0.05  # nats of posterior entropy that a round must win, or the rounds end


@dataclass(frozen=True)
class SequentialConfig:
    """How rounds are made.

    Attributes:
      rounds: at most.
      simulations: a round.
      quantile: of the posterior's density: where its draws are taken to end.
      wider: how many times as far from its peak truncated proposals do.
      samples: posterior draws that set the threshold, and candidates that set the bounding box and the share kept; or
        those that set the normaliser of a corrected posterior.
      oversampling: candidates for each draw that importance resampling chooses from.
      narrows: nats of entropy that a round must take from the posterior for another to follow.
      held_out: share of each round that is held out.
      anew: whether every later round trains a network of new weights; one that goes on from the last round's may learn
        what is new less well (Ash and Adams, On warm-starting neural network training, NeurIPS 2020).
      proposal: of later rounds: "truncated", the prior where the posterior has mass, or "posterior", draws of it.
      seed: of proposals, simulations and new weights.
    """

    rounds: int = 5
    simulations: int = 1000
    quantile: float = QUANTILE
    wider: float = WIDER
    samples: int = 2000
    oversampling: int = 16
    narrows: float = _NARROWS
    held_out: float = 0.1
    anew: bool = False
    proposal: str = TRUNCATED
    seed: int = 0

    def __post_init__(self) -> None:
        least_of = {"rounds": 1, "simulations": 20, "samples": 100, "oversampling": 1, "seed": 0}
        for name, least in least_of.items():
            require_whole(f"sequential: {name}", getattr(self, name), least)
        if np.isnan(self.narrows):  # by which nothing would ever stop
            raise InputError("sequential: narrows is nan, want nats that a round must win")
        if not 0 < self.quantile < 0.5 or not 0 < self.held_out < 1:
            raise InputError(f"sequential: quantile in (0, 0.5), held_out in (0, 1): {self.quantile}, {self.held_out}")
        if not 1 <= self.wider < np.inf:  # what is closer in would cut the posterior off
            raise InputError(f"sequential: wider is {self.wider}, want a number of 1 or more")
        if self.proposal not in PROPOSALS:
            raise InputError(f"sequential: proposal is one of {', '.join(PROPOSALS)}, got {self.proposal!r}")


def reach(gain: Array, config: SequentialConfig) -> tuple[float, float]:
    """The highest of `gain` (n,), log densities over the prior's of draws, and how far proposals go below it, nats.

    That is `wider` times as far as a quantile of them, as distances go in a normal likelihood, whose nats are squares.
    """
    highest = float(gain.max())
    return highest, config.wider**2 * (highest - float(np.quantile(gain, config.quantile)))


class TruncatedPrior:
    """The uniform prior, where a posterior's density exceeds what it is at some distance from its peak; see `reach`.

    Plain rejection from the prior accepts one in e^gain: never, in 37 dimensions. Rejection inside a bounding box of
    what lies there is exact and used where it accepts enough; elsewhere candidates above the threshold are
    resampled by weight. Three in four are of a normal through the posterior's draws, and wider: nearly all of a
    region's volume lies near its edge, where draws of the posterior hardly ever do. The others are such draws, for
    posteriors that are no normal.

    Args:
      posterior: given a window.
      config: see `SequentialConfig`.
      rng: of the draws that set the threshold.

    Attributes:
      threshold: log density, relative to the prior, that a proposal exceeds.
      kept: share of the prior's volume above it, estimated from such candidates.
    """

    def __init__(self, posterior: NeuralPosterior, config: SequentialConfig, rng: np.random.Generator) -> None:
        self.posterior, self.config = posterior, config
        psi = drawn(posterior, config.samples, rng)
        gain = told(posterior, psi)
        highest, depth = reach(gain, config)
        self.threshold = highest - depth
        self.wide = _filling(Normal.through(posterior.prior.to_z(psi)), depth)
        tried, log_weight = self._candidates(config.samples, rng)
        self.kept = float(min(1.0, np.exp(log_weight).mean()))
        u = posterior.prior.u_of(np.concatenate([psi, tried[np.isfinite(log_weight)]]))
        margin = (u.max(0) - u.min(0)) / config.samples  # a bounding box of draws is a little too small
        self.low, self.high = np.clip(u.min(0) - margin, 0, 1), np.clip(u.max(0) + margin, 0, 1)

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """(n, d) psi, physical units."""
        free = np.array(self.posterior.prior.free)
        share = self.kept / max(float(np.prod((self.high - self.low)[free])), 1e-300)
        if share * self.config.oversampling >= 1:
            found = self._rejected(n, rng)
            if len(found) == n:
                return found
        return self._resampled(n, rng)

    def _rejected(self, n: int, rng: np.random.Generator) -> Array:
        found: list[Array] = []
        for _ in range(4):
            u = rng.uniform(self.low, self.high, (n * self.config.oversampling, len(self.low)))
            psi = self.posterior.prior.psi_of(u)
            found.append(psi[told(self.posterior, psi) > self.threshold])
            if sum(map(len, found)) >= n:
                break
        return np.concatenate(found)[:n]

    def _resampled(self, n: int, rng: np.random.Generator) -> Array:
        psi, log_weight = self._candidates(n * self.config.oversampling, rng)
        return psi[chosen(log_weight, n, rng)]

    def _candidates(self, n: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """(n, d) psi, and (n,) the log weights that make them the prior above the threshold."""
        prior, own = self.posterior.prior, max(1, round(_OWN * n))
        wide = prior.from_z(self.wide.sample(n - own, rng))
        psi = np.concatenate([drawn(self.posterior, own, rng), wide])
        gain = told(self.posterior, psi)
        normal = self.wide.gain(prior.to_z(psi))
        mixed = np.logaddexp(gain + np.log(own / n), normal + np.log1p(-own / n)) if own < n else gain
        return psi, np.where(gain > self.threshold, -mixed, -np.inf)


def _filling(normal: Normal, depth: float) -> Normal:
    """One as wide as the region in which its log density over the prior's is within `depth` nats of its highest.

    It is the prior times a wider likelihood: where nothing was told the prior is all that there is to fill.
    """
    spread, axes = np.linalg.eigh(normal.covariance)
    precision = np.maximum(1 / spread - 1, 0)
    told_of = (precision / (1 + precision)).sum()  # dimensions
    wider = max(1.0, _FILLS * 2 * depth / (told_of + 2))  # an even ball of radius R has variance R^2 / (d + 2)
    return Normal(normal.mean, axes / (1 / spread - precision + precision / wider) @ axes.T)


class Corrected:
    """The posterior under the prior's box, of a network that learned from draws of earlier posteriors too.

    With shares c_i of all windows from proposals g_i and the rest from the prior p the network learns the likelihood
    times r p, where r = c_0 + sum_i c_i g_i / p is at least c_0. Dividing by r is what is left to do. What is learned
    is narrower than the posterior, up to sqrt(2) times in each direction, so that draws of it alone would seldom lie
    where the posterior's tails do: half of the candidates are the first proposal's, which is wider (importance sampling
    from a mixture: Owen and Zhou 2000).

    Args:
      learned: what the network says, given the window.
      proposals: (posterior given the same window, number of windows drawn from it).
      first: number of windows drawn from the prior.
      config: `samples` draws set the normaliser; `oversampling` candidates are drawn for each sample.
      rng: of these draws.
    """

    def __init__(
        self, learned: NeuralPosterior, proposals: "Sequence[tuple[Believed, int]]", first: int,
        config: SequentialConfig, rng: np.random.Generator,
    ) -> None:  # fmt: skip
        self.learned, self.proposals, self.first, self.config = learned, tuple(proposals), first, config
        self._log_norm = float(np.logaddexp.reduce(self._candidates(config.samples, rng)[1]) - np.log(config.samples))

    @property
    def network(self) -> Network:
        """The network that learned."""
        return self.learned.network

    @property
    def prior(self) -> PriorBox:
        """Psi's box."""
        return self.learned.prior

    def _log_ratio(self, psi: Array) -> Array:
        """(n,) log of the density that psi (n, d) of all windows were drawn with, over the prior's."""
        counts = np.array([self.first, *(n for _, n in self.proposals)], float)
        gains = [np.zeros(len(psi))]
        gains += [told(g, psi) for g, _ in self.proposals]
        weighted = np.stack(gains) + np.log(counts / counts.sum())[:, None]
        return np.logaddexp.reduce(weighted, 0)

    def _candidates(self, n: int, rng: np.random.Generator, **how: Any) -> tuple[Fidelity, Array]:
        """`n` draws, and (n,) log weights that make them the posterior, but for its normaliser.

        They are what was learned and the first proposal, half of each; where there are parts without a density, what
        was learned alone.
        """
        half = n // 2
        own = self.learned.sample(n - half, rng, **how)
        first = self.learned if "delta_e" in own.given else self.proposals[0][0]
        others = first.sample(half, rng, **how) if half else own[:0]
        both = Fidelity(**{p: np.concatenate([getattr(own, p), getattr(others, p)]) for p in own.given})
        assert both.psi is not None  # a posterior always speaks of psi
        if first is self.learned:
            return both, -self._log_ratio(both.psi)
        learned, other = self.learned.log_prob(both), first.log_prob(both)
        mixed = np.logaddexp(learned + np.log1p(-half / n), other + np.log(half / n)) if half else learned
        return both, learned - self._log_ratio(both.psi) - mixed

    def log_prob(self, x: Fidelity, **how: Any) -> Array:
        """(n,) log density in nats; see `NeuralPosterior.log_prob`."""
        value = self.learned.log_prob(x, **how)
        assert x.psi is not None  # or the line before had refused x
        return value - self._log_ratio(np.atleast_2d(x.psi)) - self._log_norm

    def sample(self, n: int, rng: np.random.Generator, **how: Any) -> Fidelity:
        """`n` draws, chosen among `oversampling` times as many candidates by importance."""
        found, log_weight = self._candidates(n * self.config.oversampling, rng, **how)
        return found[chosen(log_weight, n, rng)]


Believed = NeuralPosterior | Corrected


def told(posterior: Believed, psi: Array) -> Array:
    """(n,) nats that a window told about psi (n, d): log posterior / prior."""
    return posterior.log_prob(Fidelity(psi)) + posterior.prior.log_volume


def drawn(posterior: Believed, n: int, rng: np.random.Generator) -> Array:
    """(n, d) psi of a posterior, physical units."""
    psi = without_maps(posterior).sample(n, rng).psi
    assert psi is not None  # a posterior always speaks of psi
    return psi


def chosen(log_weight: Array, n: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """(n,) indices drawn by weight without replacement: two simulations of one psi would tell less than two of two."""
    return np.argsort(-(log_weight + rng.gumbel(size=len(log_weight))))[:n]


class Proposed:
    """Draws of a posterior as proposals; `kept` is e to the entropy relative to the prior, a share of its volume."""

    def __init__(self, posterior: Believed, config: SequentialConfig, rng: np.random.Generator) -> None:
        self.posterior = posterior
        self.kept = float(np.exp(-told(posterior, self.sample(config.samples, rng)).mean()))

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """(n, d) psi, physical units."""
        return drawn(self.posterior, n, rng)
