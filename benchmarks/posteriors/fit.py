"""Train one method on one set, within a number of epochs and perhaps of seconds."""

import time
from copy import deepcopy
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import torch

from nfc_gym.inference import checkpoint
from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.network import Network
from nfc_gym.inference.progress import Report
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import Outcome, TrainConfig, train
from posteriors.fitted import Fitted, Ours
from posteriors.methods import METHODS, network_config
from posteriors.sets import Held

HELD_OUT = 0.05  # of the training windows, to compare epochs by
_TIMED, _WARM = 10, 3  # steps that tell how long an epoch takes, after some that are not timed


class Plan(NamedTuple):
    """How every cell is trained.

    Attributes:
      epochs: at most.
      budget: seconds of training a cell; 0 sets none.
      batch: windows a step.
      rate: step size.
      small: networks of a toy's size.
    """

    epochs: int
    budget: float
    batch: int
    rate: float
    small: bool


class Cell(NamedTuple):
    """What training came to."""

    fitted: Fitted
    outcome: Outcome
    epochs: int


def fit(
    method: str, inputs: str, windows: Held, prior: PriorBox, plan: Plan, seed: int, folder: Path,
    device: torch.device, report: Report,
) -> Cell:  # fmt: skip
    """Train, or go on where an earlier command was killed; the posterior is kept in the folder too."""
    if METHODS[method].peer:
        from posteriors.peers import fit_peer

        return Cell(*fit_peer(METHODS[method], inputs, windows, prior, plan, seed, device))
    return fit_network(network_config(METHODS[method], inputs, plan.small), windows, prior, plan, seed, folder,
                       device, report)  # fmt: skip


def fit_network(
    config: NetworkConfig, windows: Held, prior: PriorBox, plan: Plan, seed: int, folder: Path, device: torch.device,
    report: Report,
) -> Cell:  # fmt: skip
    """The same for a network of any configuration."""
    folder.mkdir(parents=True, exist_ok=True)
    network = Network(config, Sizes.of(windows.tensors), prior, seed).to(device)
    first, held_out = windows.split(HELD_OUT)
    training = TrainConfig(epochs=plan.epochs, batch=plan.batch, rate=plan.rate, seed=seed)
    training = replace(training, epochs=affordable(network, first, training, plan.budget, folder, device))
    outcome = train(network, first, held_out, training, folder=folder, device=device, report=report)
    checkpoint.save(folder / "posterior.safetensors", network)
    return Cell(Ours(network), outcome, training.epochs)


def affordable(
    network: Network, windows: Held, training: TrainConfig, budget: float, folder: Path, device: torch.device
) -> int:  # fmt: skip
    """Epochs that fit into the budget: the step size must know beforehand where it ends.

    Some steps are timed on a copy; the number is kept in the folder, so that a run that goes on keeps to it.
    """
    kept = folder / "epochs"
    if kept.is_file():
        return int(kept.read_text())
    epochs = training.epochs
    if budget:
        copy = deepcopy(network)
        copy.fit_scales(next(iter(windows.batches(min(len(windows), 1024), 0))))
        optimiser = torch.optim.AdamW(copy.parameters(), lr=1e-6)
        began = 0.0
        steps = list(islice(windows.batches(training.batch, 0), _WARM + _TIMED))
        for i, batch in enumerate(steps):
            if i == min(_WARM, len(steps) - 1):
                began = _now(device)
            with torch.autocast(device.type, torch.bfloat16, training.mixed and device.type == "cuda"):
                loss = torch.stack(list(copy.losses(batch).values())).sum()
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
        timed = len(steps) - min(_WARM, len(steps) - 1)
        an_epoch = (_now(device) - began) / timed * len(windows) / training.batch
        epochs = max(1, min(epochs, int(budget / max(an_epoch, 1e-6))))
    kept.write_text(str(epochs))
    return epochs


def _now(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.monotonic()
