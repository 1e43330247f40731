"""`refine`: what a network believes of one window, learned anew from windows of the same commands.

A network that is to read any window reads each a little coarsely, however many it has seen. Windows of the same
commands, from where this one may have begun (`simulate.Repeated`), differ by psi and noise alone: a small network and a
linear start read those to the last digit. They are simulated where the first posterior has mass, and then where the
new one has, so that its answer stays the prior's posterior (`sequential`), for this window and no other.
"""

from dataclasses import replace
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.inference.config import NetworkConfig
from nfc_gym.inference.data import Batch
from nfc_gym.inference.network import Network
from nfc_gym.inference.posterior import NeuralPosterior, Window
from nfc_gym.inference.progress import Report, quiet
from nfc_gym.inference.proposals import Around, SequentialConfig
from nfc_gym.inference.sequential import Rounds, sequential
from nfc_gym.inference.train import TrainConfig

# Few windows that differ by little: of 400 others of a Jackal's and an Ant's commands 5000 tell this flow 0.366 and
# 0.536 nats a parameter, a score model 0.312 (Jackal), mixtures 0.24 to 0.26 and 0.45 to 0.46.
NETWORK = NetworkConfig(encoder="nn", width=512, features=256, density="flow", aligned=True, linear=True)
SIMULATIONS = 10_000
FRESH = 500  # windows beside those, from which the answer's width is taken


def halved(simulations: int, seed: int = 0) -> SequentialConfig:
    """Two rounds with so many simulations in all: 2 x 5000 tell more than 10,000 do, on most robots by far.

    `FRESH` more tell how wide the answer is to be.
    """
    return SequentialConfig(2, simulations // 2, anew=True, oversampling=8, fresh=FRESH, seed=seed)


class Again(Protocol):
    """Windows of the same commands, without the sensors' noise; see `simulate.Repeated`."""

    @property
    def noise(self) -> NDArray[np.float64]:
        """(H+1, s) standard deviation of what is to be added to their states."""
        ...

    def __call__(self, psi: NDArray[np.float64], rng: np.random.Generator) -> Batch:
        """A batch of n windows, one for each psi (n, d) in physical units."""
        ...


def refine(
    posterior: NeuralPosterior, window: Window, again: Again, config: SequentialConfig | None = None,
    training: TrainConfig | None = None, *, network: NetworkConfig = NETWORK, device: str | torch.device = "cpu",
    report: Report = quiet,
) -> Rounds:  # fmt: skip
    """Learn what one window tells of psi from windows of its own commands.

    Args:
      posterior: trained on windows of any motion; the first round is drawn where it has mass.
      window: what was observed.
      again: simulates windows of the same commands, `simulate.Repeated`.
      config: rounds; by default two with `SIMULATIONS` in all, of which the second trains new weights, and `FRESH` more
        windows for the answer's width.
      training: of each round.
      network: what learns.
      device: to train on; the posterior's network stays where it is.
      report: is told of the progress.

    Returns:
      As of `sequential`. `posterior` of it speaks of psi alone.

    Raises:
      InputError: a window that is not the network's, a network with maps or more than psi, or a posterior of maps.
    """
    if network.elevation or network.delta_s or network.families or posterior.network.config.elevation:
        raise InputError("refine: it is psi that is learned anew, from states and actions alone, without maps")
    config = config or halved(SIMULATIONS)
    given, rng = posterior.of("psi").given(window), np.random.default_rng([config.seed, 1])
    within = Around(given, config, rng)
    sizes = replace(posterior.network.sizes, layout=None)
    learner = Network(network, sizes, posterior.prior, config.seed).to(device)
    return sequential(
        learner, again, window, config, training, within=within, device=device, report=report, noise=again.noise
    )
