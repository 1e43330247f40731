"""Sequential rounds by truncated proposals: simulate where the posterior of one window still has mass.

Each round draws psi from the prior restricted to where the present posterior's density exceeds its own 5e-4 quantile
(truncated sequential posterior estimation: Deistler et al. 2022; for scores, Sharrock et al. 2024), simulates,
appends to all earlier rounds and trains on. Inside the truncated region the proposal is proportional to the prior, so
the loss needs no correction; the posterior of the *given* window stays right, that of others does not.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.inference.data import Batch, TensorWindows
from nfc_gym.inference.network import Network
from nfc_gym.inference.posterior import NeuralPosterior, Window
from nfc_gym.inference.progress import Report, quiet
from nfc_gym.inference.random import mixed
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import Outcome, TrainConfig, train

Array = NDArray[np.float64]
Simulator = Callable[[Array, np.random.Generator], Batch]
QUANTILE = 5e-4  # of the posterior's density, below which nothing is proposed
_NARROWS = 0.05  # nats of posterior entropy that a round must win, or the rounds end


@dataclass(frozen=True)
class SequentialConfig:
    """How rounds are made.

    Attributes:
      rounds: at most.
      simulations: a round.
      quantile: of the posterior's density, below which nothing is proposed.
      samples: posterior draws that set the threshold and the bounding box.
      oversampling: candidates for each proposal that importance resampling chooses from.
      narrows: nats of entropy that a round must take from the posterior for another to follow.
      held_out: share of each round that is held out.
      anew: whether every later round trains a network of new weights; one that goes on from the last round's may learn
        what is new less well (Ash and Adams, On warm-starting neural network training, NeurIPS 2020).
      inside: whether later rounds learn only from those earlier windows whose psi the present proposal could draw.
      seed: of proposals, simulations and new weights.
    """

    rounds: int = 5
    simulations: int = 1000
    quantile: float = QUANTILE
    samples: int = 2000
    oversampling: int = 16
    narrows: float = _NARROWS
    held_out: float = 0.1
    anew: bool = False
    inside: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if self.rounds < 1 or self.simulations < 20 or self.samples < 100 or self.oversampling < 1:
            raise InputError("sequential: want rounds >= 1, simulations >= 20, samples >= 100 and oversampling >= 1")
        if not 0 < self.quantile < 0.5 or not 0 < self.held_out < 1:
            raise InputError(f"sequential: quantile in (0, 0.5), held_out in (0, 1): {self.quantile}, {self.held_out}")


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

    posterior: NeuralPosterior
    entropy: list[float] = field(default_factory=list)
    kept: list[float] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)
    windows: TensorWindows | None = None
    stopped: str = "rounds"


class TruncatedPrior:
    """The uniform prior, where a posterior's density exceeds a quantile of its own draws' densities.

    Plain rejection from the prior accepts one in e^gain: never, in 37 dimensions. Rejection inside the bounding box of
    the posterior's draws is exact and used where it accepts enough; elsewhere posterior draws above the threshold are
    resampled with weights prior / posterior.

    Args:
      posterior: given a window.
      config: see `SequentialConfig`.
      rng: of the draws that set the threshold.

    Attributes:
      threshold: log density, relative to the prior, that a proposal exceeds.
      kept: share of the prior's volume above it, estimated from posterior draws.
    """

    def __init__(self, posterior: NeuralPosterior, config: SequentialConfig, rng: np.random.Generator) -> None:
        self.posterior, self.config = posterior, config
        psi, gain = self._draws(config.samples, rng)
        self.threshold = float(np.quantile(gain, config.quantile))
        u = posterior.prior.u_of(psi)
        margin = (u.max(0) - u.min(0)) / config.samples  # a bounding box of draws is a little too small
        self.low, self.high = np.clip(u.min(0) - margin, 0, 1), np.clip(u.max(0) + margin, 0, 1)
        inside = gain > self.threshold
        self.kept = float(min(1.0, np.exp(-gain[inside]).sum() / config.samples))

    def _draws(self, n: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Draws of the posterior, and what the window told about each: log q / prior."""
        drawn = self.posterior.sample(n, rng).psi
        assert drawn is not None  # a posterior always speaks of psi
        return drawn, self._gain(drawn)

    def _gain(self, psi: Array) -> Array:
        return self.posterior.log_prob(Fidelity(psi)) + self.posterior.prior.log_volume

    def holds(self, psi: Array) -> NDArray[np.bool_]:
        """(n,) which psi (n, d), physical units, could be drawn."""
        return self._gain(psi) > self.threshold

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
            found.append(psi[self.holds(psi)])
            if sum(map(len, found)) >= n:
                break
        return np.concatenate(found)[:n]

    def _resampled(self, n: int, rng: np.random.Generator) -> Array:
        psi, gain = self._draws(n * self.config.oversampling, rng)
        weight = np.where(gain > self.threshold, np.exp(gain.min() - gain), 0.0)
        # without replacement: two simulations of one psi would tell less than two of two
        keys = np.log(np.maximum(weight, 1e-300)) + rng.gumbel(size=len(weight))
        return psi[np.argsort(-keys)[:n]]


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
    rng = np.random.default_rng(config.seed)
    out = Rounds(NeuralPosterior(network))
    train_set: TensorWindows | None = None
    held_out: TensorWindows | None = None
    for r in range(config.rounds):
        if r:
            proposal = TruncatedPrior(out.posterior, config, rng)
            out.kept.append(proposal.kept)
            new = _simulated(network.prior, simulate, proposal.sample(config.simulations, rng), rng)
            if config.inside:
                assert train_set is not None  # the first round made both
                assert held_out is not None
                train_set, held_out = (_within(w, proposal, network.prior) for w in (train_set, held_out))
            if config.anew:
                _renew(network, mixed(config.seed, r))
        else:
            out.kept.append(1.0)
            new = begun or _simulated(network.prior, simulate, _prior(network.prior, config.simulations, rng), rng)
        first, last = new.split(config.held_out)
        train_set = first if train_set is None else train_set.append(first)
        held_out = last if held_out is None else held_out.append(last)
        if r or begun is None:
            told = train(network, train_set, held_out, training, device=device, report=report, scales=scales)
            out.outcomes.append(told)
        out.posterior = NeuralPosterior(network).given(window)
        out.entropy.append(-float(TruncatedPrior(out.posterior, config, rng)._draws(config.samples, rng)[1].mean()))
        report.message(f"round {r + 1}: {len(train_set)} windows, posterior entropy {out.entropy[-1]:.3f} nats")
        if r and out.entropy[-2] - out.entropy[-1] < config.narrows:
            out.stopped = "no longer narrows"
            break
    assert train_set is not None  # at least one round was made
    assert held_out is not None
    out.windows = train_set.append(held_out)
    return out


def _within(windows: TensorWindows, proposal: TruncatedPrior, prior: PriorBox) -> TensorWindows:
    """Those of the windows whose psi a proposal could draw; all of them where it could draw none."""
    inside = torch.as_tensor(proposal.holds(prior.psi_of(windows.tensors["psi"].double().cpu().numpy())))
    if not inside.any():
        return windows
    return TensorWindows({k: t[inside.to(t.device)] for k, t in windows.tensors.items()}, windows.manifest)


def _renew(network: Network, seed: int) -> None:
    """Give a network the weights that a new one begins with; its scales stay."""
    new = Network(network.config, network.sizes, network.prior, seed)
    with torch.no_grad():
        for own, other in zip(network.parameters(), new.parameters(), strict=True):
            own.copy_(other)


def _prior(prior: PriorBox, n: int, rng: np.random.Generator) -> Array:
    """(n, d) psi, physical units."""
    return prior.psi_of(rng.uniform(size=(n, len(prior))))


def _simulated(prior: PriorBox, simulate: Simulator, psi: Array, rng: np.random.Generator) -> TensorWindows:
    batch: dict[str, Any] = dict(simulate(psi, rng))
    batch["psi"] = torch.as_tensor(prior.u_of(psi), dtype=torch.float32).clamp(0, 1)
    return TensorWindows(batch)
