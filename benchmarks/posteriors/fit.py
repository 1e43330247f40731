"""Train one method on one set, within a number of epochs and perhaps of seconds."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from nfc_gym.inference import checkpoint
from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.encoders.place import place_of
from nfc_gym.inference.network import Network
from nfc_gym.inference.progress import Report
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import Outcome, TrainConfig, train
from posteriors.fitted import Fitted, Ours
from posteriors.methods import METHODS, network_config
from posteriors.sets import Held

HELD_OUT = 0.05  # of the training windows, to compare epochs by
_WARM, _TIMED = 5, 25  # steps that are not timed, then those that tell how long an epoch takes
_SAVE = 30.0  # seconds between saved states


class Plan(NamedTuple):
    """How every cell is trained.

    Attributes:
      epochs: at most.
      budget: seconds of training a cell; 0 sets none.
      batch: windows a step.
      rate: step size.
      draws: of noise a window and step, of score models.
      small: networks of a toy's size.
    """

    epochs: int
    budget: float
    batch: int
    rate: float
    draws: int
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
    config = network_config(METHODS[method], inputs, plan.small, plan.draws)
    return fit_network(config, windows, prior, plan, seed, folder, device, report)


def fit_network(
    config: NetworkConfig, windows: Held, prior: PriorBox, plan: Plan, seed: int, folder: Path, device: torch.device,
    report: Report,
) -> Cell:  # fmt: skip
    """The same for a network of any configuration."""
    folder.mkdir(parents=True, exist_ok=True)
    sizes = Sizes.of(windows.tensors, place=place_of(windows.names))
    network = Network(config, sizes, prior, seed).to(device)
    first, held_out = windows.split(HELD_OUT)
    training = TrainConfig(
        epochs=plan.epochs, batch=plan.batch, rate=plan.rate, seed=seed, save_every=_SAVE, mixed=config.elevation
    )
    with rounded(device):
        training = replace(training, epochs=affordable(network, first, held_out, training, plan.budget, folder, device))
        outcome = train(network, first, held_out, training, folder=folder, device=device, report=report)
    checkpoint.save(folder / "posterior.safetensors", network)
    return Cell(Ours(network), outcome, training.epochs)


@contextmanager
def rounded(device: torch.device) -> Iterator[None]:
    """Products of single precision are rounded to a GPU's 19 bits meanwhile, five times as fast, as in bfloat16, whose
    eight digits would swallow what small motions tell; densities and draws are computed outside, in full."""
    before = torch.get_float32_matmul_precision()
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def affordable(
    network: Network, windows: Held, held_out: Held, training: TrainConfig, budget: float, folder: Path,
    device: torch.device,
) -> int:  # fmt: skip
    """Epochs that fit into the budget: the step size must know beforehand where it ends.

    A short training of a copy is timed; the number is kept in the folder, so that a run that goes on keeps to it.
    """
    kept = folder / "epochs"
    if kept.is_file():
        return int(kept.read_text())
    epochs = training.epochs
    if budget:
        copy = deepcopy(network)

        def seconds(steps: int) -> float:
            """Of an epoch of that many steps with its share of held-out windows, made of the set's first ones."""
            some = windows.first(steps * training.batch)
            few = held_out.first(math.ceil(len(some) * HELD_OUT))
            return train(copy, some, few, replace(training, epochs=1), device=device).seconds / len(some)

        seconds(_WARM)
        epochs = max(1, min(epochs, int(budget / max(seconds(_TIMED) * len(windows), 1e-6))))
    kept.write_text(str(epochs))
    return epochs
