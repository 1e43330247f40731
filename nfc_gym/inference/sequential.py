"""Sequential rounds: simulate where the posterior of one window has mass, and learn from that too.

By default each round draws psi from the prior restricted to where the present posterior's density exceeds its own 5e-4
quantile (truncated sequential posterior estimation: Deistler et al. 2022; for scores, Sharrock et al. 2024), simulates,
appends to all earlier rounds and trains on. Inside the truncated region the proposal is proportional to the prior, so
the loss needs no correction. With draws of the posterior itself the answer is corrected instead (`proposals`). Either
way the posterior of the *given* window stays right, that of others does not.
"""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from nfc_gym.inference.data import Batch, TensorWindows
from nfc_gym.inference.network import Network
from nfc_gym.inference.posterior import NeuralPosterior, Window
from nfc_gym.inference.progress import Report, quiet
from nfc_gym.inference.proposals import (
    TRUNCATED,
    Believed,
    Corrected,
    Proposed,
    SequentialConfig,
    TruncatedPrior,
    drawn,
    told,
)
from nfc_gym.inference.random import mixed, seeded
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import Outcome, TrainConfig, train

Array = NDArray[np.float64]
Simulator = Callable[[Array, np.random.Generator], Batch]


@dataclass
class Rounds:
    """What the rounds came to.

    Attributes:
      posterior: given the window, after the last round.
      entropy: of the posterior after each round, nats, relative to the prior (0 is the prior; lower is narrower).
      kept: share of the prior's volume that each round's proposal was drawn from.
      outcomes: of each round's training.
      windows: what the last round learned from, held out windows too.
      stopped: "rounds" or "no longer narrows".
    """

    posterior: Believed
    entropy: list[float] = field(default_factory=list)
    kept: list[float] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)
    windows: TensorWindows | None = None
    stopped: str = "rounds"


def sequential(
    network: Network, simulate: Simulator, window: Window, config: SequentialConfig | None = None,
    training: TrainConfig | None = None, *, begun: TensorWindows | None = None, device: str | torch.device = "cpu",
    report: Report = quiet, scales: bool = True,
) -> Rounds:  # fmt: skip
    """Infer psi from one window in rounds of simulations that close in on it.

    Args:
      network: as built, or trained before.
      simulate: (psi (n, d) in physical units, generator) -> a batch of n windows without `psi`; see `data`.
      window: what was observed.
      config: see `SequentialConfig`.
      training: of each round, on all windows so far.
      begun: windows whose psi is drawn from the prior and which the network has been trained on: they are the first
        round, whatever their number, for any window that was observed.
      device: to train on.
      report: is told of the progress.
      scales: see `train`; a network that was trained before on other windows is to keep its own.

    Raises:
      InputError: the simulator returns windows that are not the network's, or another number of them.
    """
    config, training = config or SequentialConfig(), training or TrainConfig(epochs=50)
    made = partial(_simulated, network.prior, simulate)
    rng = np.random.default_rng(config.seed)
    out = Rounds(NeuralPosterior(network))
    believed, seen = _Beliefs(window, config), _Seen(config.held_out)
    for r in range(config.rounds):
        if r:
            proposal = believed.proposal(network, rng)
            out.kept.append(proposal.kept)
            new = made(proposal.sample(config.simulations, rng), rng)
            if config.anew:
                _renew(network, mixed(config.seed, r))
        else:
            out.kept.append(1.0)
            new = begun or made(_prior(network.prior, config.simulations, rng), rng)
            believed.first = len(new)
        learned, held_out = seen.with_more(new)
        if r or begun is None:
            outcome = train(network, learned, held_out, training, device=device, report=report, scales=scales)
            out.outcomes.append(outcome)
            if network.density.widens:
                _calibrate(network, held_out, config.seed)
        out.posterior = believed.now(network, rng)
        out.entropy.append(-float(told(out.posterior, drawn(out.posterior, config.samples, rng)).mean()))
        out.windows = learned.append(held_out)
        report.message(f"round {r + 1}: {len(learned)} windows, posterior entropy {out.entropy[-1]:.3f} nats")
        if r and out.entropy[-2] - out.entropy[-1] < config.narrows:
            out.stopped = "no longer narrows"
            break
    return out


class _Seen:
    """The windows of all rounds so far: a share of each round is held out.

    Args:
      share: that share.
    """

    def __init__(self, share: float) -> None:
        self.share, self._parts = share, ()

    def with_more(self, new: TensorWindows) -> tuple[TensorWindows, TensorWindows]:
        """To train on and held out, with those of another round."""
        parts = new.split(self.share)
        if self._parts:
            parts = tuple(old.append(more) for old, more in zip(self._parts, parts, strict=True))
        self._parts = parts
        return parts


class _Beliefs:
    """What was believed of the window from round to round.

    Attributes:
      first: windows from the prior.
    """

    def __init__(self, window: Window, config: SequentialConfig) -> None:
        self.window, self.config, self.first = window, config, 0
        self._proposals: list[tuple[Believed, int]] = []

    def now(self, network: Network, rng: np.random.Generator) -> Believed:
        """What the network says, under the prior."""
        learned = NeuralPosterior(network).given(self.window)
        return Corrected(learned, self._proposals, self.first, self.config, rng) if self._proposals else learned

    def proposal(self, network: Network, rng: np.random.Generator) -> TruncatedPrior | Proposed:
        """Of the next round; a posterior whose draws it learns from is kept as it is now."""
        if self.config.proposal == TRUNCATED:
            return TruncatedPrior(NeuralPosterior(network).given(self.window), self.config, rng)
        kept = self.now(deepcopy(network), rng)
        self._proposals.append((kept, self.config.simulations))
        return Proposed(kept, self.config, rng)


def _calibrate(network: Network, held_out: TensorWindows, seed: int) -> None:
    """Take the density's width from what was held out."""
    device = next(network.parameters()).device
    (batch,) = held_out.batches(len(held_out), None)
    with seeded(seed, device):
        network.calibrate({name: t.to(device) for name, t in batch.items()})


def _renew(network: Network, seed: int) -> None:
    """Give a network the weights that a new one begins with; the scales of what it sees and says stay."""
    new = Network(network.config, network.sizes, network.prior, seed)
    with torch.no_grad():
        for own, other in zip(network.parameters(), new.parameters(), strict=True):
            own.copy_(other)
        # The width that the last round's weights were calibrated to is theirs: a new flow begins at N(0, I).
        for own, other in zip(network.density.buffers(), new.density.buffers(), strict=True):
            own.copy_(other)


def _prior(prior: PriorBox, n: int, rng: np.random.Generator) -> Array:
    """(n, d) psi, physical units."""
    return prior.psi_of(rng.uniform(size=(n, len(prior))))


def _simulated(prior: PriorBox, simulate: Simulator, psi: Array, rng: np.random.Generator) -> TensorWindows:
    batch: dict[str, Any] = dict(simulate(psi, rng))
    batch["psi"] = torch.as_tensor(prior.u_of(psi), dtype=torch.float32).clamp(0, 1)
    return TensorWindows(batch)
