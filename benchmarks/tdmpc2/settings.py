"""Hyperparameters of TD-MPC2, as published; one set for all tasks."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from nfc_gym.core.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Hyperparameters, after the paper's table of them and the authors' configuration file.

    Source: arXiv:2310.16828, appendix on implementation; github.com/nicklashansen/tdmpc2, tdmpc2/config.yaml (0d38ce5).

    Attributes:
      latent, simplex: size of a latent state, and of the groups of it that each sum to one.
      encoder, hidden: widths of the encoder's and of all other layers.
      critics: value networks in the ensemble.
      bins, bound: of two-hot regression; the bins lie evenly in [-bound, bound] of symlog.
      dropout: in the first layer of each critic.
      horizon: steps that are planned and unrolled in training.
      samples, elites, priors, iterations: of a plan: action sequences drawn, the best of them that are kept, those that
        come from the policy prior, and rounds.
      temperature, min_std, max_std: of the elites' weights, and limits of what is drawn from.
      batch: sequences an update.
      rate, encoder_rate, clip: step size, the encoder's share of it, and largest norm of a gradient.
      follow: share by which target critics and the scale of values follow an update.
      rho: weight of each further step of the horizon, relative to the one before.
      consistency, reward, value, termination, entropy: weights of the losses.
      capacity: sequences that are kept.
      episodic: whether episodes can end early; a network then predicts which states end them.
    """

    latent: int = 512
    simplex: int = 8
    encoder: int = 256
    hidden: int = 512
    critics: int = 5
    bins: int = 101
    bound: float = 10.0
    dropout: float = 0.01
    horizon: int = 3
    samples: int = 512
    elites: int = 64
    priors: int = 24
    iterations: int = 6
    temperature: float = 0.5
    min_std: float = 0.05
    max_std: float = 2.0
    batch: int = 256
    rate: float = 3e-4
    encoder_rate: float = 0.3
    clip: float = 20.0
    follow: float = 0.01
    rho: float = 0.5
    consistency: float = 20.0
    reward: float = 0.1
    value: float = 0.1
    termination: float = 1.0
    entropy: float = 1e-4
    capacity: int = 1_000_000
    episodic: bool = True

    def __post_init__(self) -> None:
        if self.latent % self.simplex:
            raise InputError(f"latent {self.latent}: want a multiple of simplex {self.simplex}")
        if not 0 <= self.priors < self.samples or not 0 < self.elites <= self.samples:
            raise InputError(f"samples {self.samples}: want more than {self.priors} priors, {self.elites} elites")


# The published sizes of 5 and of 1 million parameters; `toy` learns easy tasks on a processor, `tiny` is for tests.
NETS: Mapping[str, Settings] = {
    "5M": Settings(),
    "1M": Settings(latent=128, hidden=384, critics=2),
    "toy": Settings(latent=64, encoder=64, hidden=96, critics=2, samples=64, elites=12, priors=8, iterations=3),
    "tiny": Settings(
        latent=16, encoder=16, hidden=16, critics=2, bins=21, samples=12, elites=4, priors=2, iterations=1, batch=8
    ),
}


def settings_of(net: str, action: int, *, episodic: bool) -> Settings:
    """Settings of a size; two more rounds of planning where an action has 20 entries or more, as in the paper.

    Raises:
      InputError: no such size.
    """
    if net not in NETS:
        raise InputError(f"--net {net!r}: there are {', '.join(NETS)}")
    found = replace(NETS[net], episodic=episodic)
    return replace(found, iterations=found.iterations + 2) if action >= 20 else found


def discount(episode: int) -> float:
    """Discount a control step for episodes of so many: (T/5 - 1) / (T/5), within [0.95, 0.995], as in the paper."""
    share = episode / 5
    return min(max((share - 1) / share, 0.95), 0.995)
