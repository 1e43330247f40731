"""`nfc-gym train --structure`: a head that says which family of effects a calibrated model lacks."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfc_gym.core import kinds
from nfc_gym.core.errors import InputError
from nfc_gym.inference import checkpoint
from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.data import Batch, StoredWindows, TensorWindows
from nfc_gym.inference.jobs import require_prior, say_unfinished
from nfc_gym.inference.network import Network
from nfc_gym.inference.progress import Report, quiet
from nfc_gym.inference.reflection import Reflection
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import Outcome, TrainConfig, train
from nfc_gym.inference.windows import Windows
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.misfit import images, of_windows
from nfc_gym.simulate.observed import require_unfeeling
from nfc_gym.simulate.witness import MISFIT

HELD_OUT = 0.05  # of the windows, by which epochs are compared
# Few passes, since windows are shown several times in each: more, and their noise is learned by heart. By AdamW: Muon
# learns it sooner (held out 2.52, trained on 1.45, where AdamW has 2.46 and 2.00; 4000 windows, three showings).
TRAINING = TrainConfig(epochs=4, rate=1e-3, muon=False, decay=0.02, patience=6)
NETWORK = NetworkConfig(encoder="tcn", density="mixture", components=1, width=384, features=256, hidden=256)


class Head(Network):
    """A network of which the structure head alone learns; its density stays the prior's."""

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Mean cross-entropy of the families over a batch."""
        assert self.structure is not None
        given = self.encode(batch["states"], batch["actions"])
        return {"structure": self.structure.loss(batch["family"], given.features).mean()}  # type: ignore[operator]


def train_structure(
    folder: Path, out: Path, training: TrainConfig, *, config: NetworkConfig = NETWORK, noise: float = 1.0,
    repeats: int = 6, mirror: bool = True, device: str | torch.device = "cpu", threads: int = 0, report: Report = quiet,
) -> Outcome:  # fmt: skip
    """Train a structure head on a folder of windows into a checkpoint; a run that was stopped goes on.

    Args:
      folder: what `nfc-gym simulate` wrote, with effects, on flat ground.
      out: the checkpoint, `.safetensors`.
      training: `TRAINING`, or another.
      config: of the network; its families are those of the windows.
      noise: what multiplies the sensor noise that the windows' manifest assumes.
      repeats: how often each window is shown, with other noise and other errors of start and parameters.
      mirror: whether half of the windows of each step are shown in each of the robot's mirrors.
      device: to train on.
      threads: of the physics; 0 takes every core, and the bits are the same.
      report: is told of the progress.

    Raises:
      InputError: windows on rough ground, without effects, of another prior, or of a robot that feels forces; something
        else than a structure head is at `out`, or what a run with other windows or settings left there.
    """
    if out.suffix != ".safetensors":
        raise InputError(f"{out}: a structure head is kept in a file that ends in .safetensors")
    kinds.require_kind(out, kinds.STRUCTURE)
    stored = Windows(folder)
    about, machine = stored.manifest, Machine(stored.manifest.environment)
    require_unfeeling(machine)
    if machine.rough:
        raise InputError(f"{folder}: windows on rough ground; a structure head is trained on flat ground")
    prior = PriorBox.of(machine.space, machine.kind.name)
    require_prior(stored, prior)
    say_unfinished(stored, report)
    cut = len(stored) - max(1, round(HELD_OUT * len(stored)))  # no repeat of a window is on both sides
    report.message(f"{len(stored):,} windows are replayed without their effects, {repeats} times each")
    first, shares = taught(stored, np.tile(np.arange(cut), repeats), machine, noise, training.seed, threads)
    held_out, _ = taught(stored, np.arange(cut, len(stored)), machine, noise, training.seed + 1, threads)
    if shares[0] == 1:
        raise InputError(f"{folder}: no window has an effect; simulate them with --effects 0.75")
    config = NetworkConfig(**{**config.to_dict(), "families": tuple(about.families)})
    network = Head(config, Sizes.of(first.tensors), prior, training.seed)
    state = out.with_name(out.name + ".training")
    state.mkdir(parents=True, exist_ok=True)
    image = Reflection(images(machine)) if mirror and machine.mirrors else None
    outcome = train(network, first, held_out, training, folder=state, device=device, report=report, mirror=image)
    notes = {
        MISFIT: True, "environment": about.environment, "windows": len(stored), "shares": shares,
        "noise": [noise * sd for sd in about.state_noise],
        "best": outcome.best, "stopped": outcome.stopped, "seconds": outcome.seconds,
        "held_out": outcome.held_out, "start": outcome.start,
    }  # fmt: skip
    checkpoint.save(out, network.cpu(), notes=notes)
    return outcome


def taught(
    stored: Windows, rows: NDArray[np.intp], machine: Machine, noise: float, seed: int, threads: int = 1
) -> tuple[TensorWindows, list[float]]:
    """Motion, misfit and family of those windows that can be replayed, and the families' shares among them."""
    states, fine = of_windows(machine, stored, rows, noise, np.random.default_rng(seed), threads)
    batch = stored.take(rows[fine], ["actions", "psi", "family"])
    shares = np.bincount(batch["family"], minlength=len(stored.manifest.families)) / max(len(batch["family"]), 1)
    arrays = {"states": states[fine], **batch}
    tensors = {k: torch.from_numpy(np.ascontiguousarray(v)) for k, v in arrays.items()}
    told = StoredWindows(stored, rows, noise=noise).told | {"repeats": len(rows) // len(np.unique(rows))}
    return TensorWindows(tensors, told=told), shares.tolist()
