"""Train one method on one set, within a number of epochs and perhaps of seconds."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch

from nfc_gym.inference import checkpoint
from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.encoders.place import place_of
from nfc_gym.inference.network import Network
from nfc_gym.inference.progress import Report
from nfc_gym.inference.reflection import Reflection
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import Outcome, TrainConfig, train
from nfc_gym.simulate.machine import Machine
from posteriors.fitted import Fitted, Ours
from posteriors.methods import METHODS, network_config
from posteriors.sets import Held, environment

HELD_OUT = 0.05  # of the training windows, to compare epochs by
_SAVE = 30.0  # seconds between saved states
_WARM = 5  # steps before the clock begins


class Plan(NamedTuple):
    """How every cell is trained.

    Attributes:
      epochs: at most.
      budget: seconds of training a cell, which are used up; 0 sets none, and training ends where it no longer helps.
      batch: windows a step.
      rate: step size.
      draws: of noise a window and step, of score models.
      small: networks of a toy's size.
      muon: whether matrices are changed by Muon, else by AdamW as all else is; no peer's are.
      compiled: whether a training step is compiled first, see `TrainConfig`; no peer's is.
      hidden: width of the densities' layers.
      mixed: bfloat16 in the networks on a GPU, in place of 19 bits; those that see maps have it in any case.
      mirror: whether half of the windows of each step are shown in each mirror; no peer's are, and none with maps.
    """

    epochs: int
    budget: float
    batch: int
    rate: float
    draws: int
    small: bool
    mirror: bool = False
    muon: bool = True
    compiled: bool = False
    hidden: int = 256
    mixed: bool = False

    @property
    def settings(self) -> dict[str, Any]:
        """What a finished cell depends on; what is not there is not named, as by earlier versions, which had none."""
        as_before = {"mirror": False, "muon": False, "compiled": False, "hidden": 256, "mixed": False}
        return {name: value for name, value in self._asdict().items() if value != as_before.get(name)}


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

        warm(network_config(METHODS[method], inputs, plan.small, plan.draws, plan.hidden), windows, prior, plan, device)
        return Cell(*fit_peer(METHODS[method], inputs, windows, prior, plan, seed, device))
    config = network_config(METHODS[method], inputs, plan.small, plan.draws, plan.hidden)
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
        epochs=plan.epochs, batch=plan.batch, rate=plan.rate, muon=plan.muon, compiled=plan.compiled, seed=seed,
        save_every=_SAVE, mixed=plan.mixed or config.elevation, budget=plan.budget,
        patience=plan.epochs if plan.budget else TrainConfig.patience,
    )  # fmt: skip
    mirror = _mirror(prior) if plan.mirror and not config.elevation else None
    warm(config, windows, prior, plan, device)
    with rounded(device):
        outcome = train(network, first, held_out, training, folder=folder, device=device, report=report, mirror=mirror)
    checkpoint.save(folder / "posterior.safetensors", network)
    return Cell(Ours(network), outcome, training.epochs)


def _mirror(prior: PriorBox) -> Reflection:
    """Of the robot that psi belongs to; the ground does not matter."""
    return Reflection(Machine(environment(prior.robot.capitalize(), "Flat")).mirrors)


def warm(config: NetworkConfig, windows: Held, prior: PriorBox, plan: Plan, device: torch.device) -> None:
    """A few steps of another network like this one, where time counts: a process's first step loads libraries.

    That takes six seconds of a core, which the first of the methods that a process trains would have had less.
    """
    if plan.budget:
        some = windows.first(_WARM * plan.batch)
        network = Network(config, Sizes.of(some.tensors, place=place_of(windows.names)), prior).to(device)
        with rounded(device):
            train(network, some, windows.first(plan.batch), TrainConfig(epochs=1, batch=plan.batch), device=device)


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
