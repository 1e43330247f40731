"""A detector that was shown faults, made in one call: lessons, training, threshold, file (`nfc-gym watch`)."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from nfc_gym.core import kinds
from nfc_gym.core.errors import InputError
from nfc_gym.core.files import require_writable
from nfc_gym.core.posterior import Sampler, without_maps
from nfc_gym.inference import detector_file
from nfc_gym.inference.data import TensorWindows
from nfc_gym.inference.detector import WindowDetector
from nfc_gym.inference.encoders.place import place_of
from nfc_gym.inference.faults import FaultClassifier, FaultConfig
from nfc_gym.inference.progress import Report, quiet
from nfc_gym.inference.rates import wanted
from nfc_gym.inference.reflection import Reflection
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import Outcome, TrainConfig, train
from nfc_gym.inference.windows import Batch
from nfc_gym.simulate.faulty import about_nominal, lessons, nominal
from nfc_gym.simulate.machine import Machine

Array = NDArray[np.float64]
TRAINING = TrainConfig(epochs=40, batch=256, rate=1e-3, patience=5, mixed=False)
HELD_OUT = 0.05  # of the lessons, by which epochs are compared
_CERTAIN = 3  # times the windows that a threshold takes at least


class Watch(NamedTuple):
    """A detector with its threshold, and what training came to."""

    detector: WindowDetector
    outcome: Outcome


def learn_faults(
    machine: Machine, made: Batch, training: TrainConfig = TRAINING, config: FaultConfig | None = None, *,
    folder: Path | None = None, device: str | torch.device = "cpu", report: Report = quiet,
) -> tuple[FaultClassifier, Outcome]:  # fmt: skip
    """Train a fault classifier on lessons, half of them in each of the robot's mirrors, with new noise in each pass.

    Args:
      machine: whose windows these are.
      made: see `lessons`.
      training: whose seed the first weights have too.
      config: what to build.
      folder: where the state is saved, and from where training goes on.
      device: to train on.
      report: is told of the progress.
    """
    names = tuple(machine.state_names)
    whole = TensorWindows(
        {k: torch.as_tensor(v) for k, v in made.items()}, noise=torch.as_tensor(machine.noise, dtype=torch.float32)
    )
    prior = PriorBox.of(machine.space, machine.kind.name)
    net = FaultClassifier.of(whole.tensors, prior, config, place_of(names), channels=names, seed=training.seed)
    outcome = train(
        net, *whole.split(HELD_OUT), training, folder=folder, device=device, report=report,
        mirror=Reflection(machine.mirrors) if machine.mirrors else None,
    )  # fmt: skip
    return net, outcome


def watch(
    environment: str, out: Path, belief: Sampler | None = None, *, windows: int = 100_000, rate: float = 0.01,
    width: float = 0.02, training: TrainConfig = TRAINING, config: FaultConfig | None = None, jobs: int = 1,
    device: str | torch.device = "cpu", report: Report = quiet,
) -> Watch:  # fmt: skip
    """Make a detector for a robot on flat ground and keep it in a file; a run that was stopped goes on.

    Args:
      environment: id.
      out: the detector, `.safetensors`; lessons and the state of training lie in a folder of that name and `.training`.
      belief: whose psi the machines have; None draws it about nominal.
      windows: lessons, half of them of machines with a fault.
      rate: wanted false-positive rate of a window.
      width: of psi about nominal, a share of the prior's range, where there is no belief.
      training: see `TrainConfig`; its seed is that of everything.
      config: of the classifier.
      jobs: processes that simulate.
      device: to train on.
      report: is told of the progress.

    Raises:
      InputError: rough ground, another ending than .safetensors, something else is there, or a rate that is none.
    """
    if out.suffix.lower() != ".safetensors":
        raise InputError(f"{out}: a detector is kept in a file that ends in .safetensors")
    kinds.require_kind(out, kinds.DETECTOR)
    require_writable(out.absolute().parent)
    enough, machine = _CERTAIN * wanted(rate), Machine(environment)
    folder = out.with_name(out.name + ".training")
    rng = np.random.default_rng([training.seed, 0])
    psi = _believed(machine, belief, width, windows + enough, rng)
    report.message(f"simulates {windows} windows to learn from, {jobs} at a time")
    made = lessons(environment, psi[:windows], training.seed, jobs=jobs, folder=folder, report=report)
    net, outcome = learn_faults(machine, made, training, config, folder=folder, device=device, report=report)
    report.message(f"simulates {enough} more without a fault, for the threshold")
    sound = nominal(environment, psi[windows:], training.seed + 1, jobs=jobs, report=report)
    detector = WindowDetector(net.to("cpu")).calibrated(sound["states"], sound["actions"], rate)
    notes = {"environment": environment, "lessons": windows, "best": outcome.best, "held_out": outcome.held_out}
    detector_file.save(out, detector, notes)
    return Watch(detector, outcome)


def _believed(machine: Machine, belief: Sampler | None, width: float, n: int, rng: np.random.Generator) -> Array:
    """(n, d) physical units."""
    if belief is not None:
        return np.asarray(without_maps(belief).sample(n, rng).psi, float)
    if not 0 <= width <= 1:
        raise InputError(f"watch: width is a share of the prior's range, 0 to 1, got {width:g}")
    return about_nominal(machine.space, width, n, rng)
