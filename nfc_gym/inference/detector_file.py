"""A detector that is a network as one safetensors file: weights, scales, threshold, and all that rebuilds it."""

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file

from nfc_gym import __version__
from nfc_gym.core.errors import InputError
from nfc_gym.core.files import replacing
from nfc_gym.inference import posterior
from nfc_gym.inference.config import Sizes
from nfc_gym.inference.contrast import Contrast, ContrastConfig
from nfc_gym.inference.detector import WindowDetector
from nfc_gym.inference.faults import FaultClassifier, FaultConfig
from nfc_gym.inference.normal import FORMAT as NORMAL
from nfc_gym.inference.normal import NormalPosterior
from nfc_gym.inference.rates import Threshold
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.state import read, require_format

FORMAT = "nfc_gym-detector-1"
_SCORERS = {"contrast": (Contrast, ContrastConfig), "faults": (FaultClassifier, FaultConfig)}
KEPT = (Contrast, FaultClassifier)  # scorers that a file holds


def save(path: str | os.PathLike[str], detector: WindowDetector, notes: dict[str, Any] | None = None) -> None:
    """Write a detector whose scorer is a `Contrast` or a `FaultClassifier`, with its threshold.

    Args:
      path: ends in `.safetensors`.
      detector: calibrated (`WindowDetector.calibrated`).
      notes: plain values kept beside it.

    Raises:
      InputError: another suffix, another scorer, or no threshold.
    """
    path, net = Path(path), detector.scorer
    if path.suffix.lower() != ".safetensors":
        raise InputError(f"{path}: a detector is kept in a file that ends in .safetensors")
    if not isinstance(net, KEPT) or detector.calibration is None:
        raise InputError(
            "save: want a detector with a Contrast or a FaultClassifier as its scorer, and a threshold: "
            "detector.calibrated(...)"
        )
    about = {
        "scorer": next(name for name, (kind, _) in _SCORERS.items() if isinstance(net, kind)),
        "nfc_gym": __version__, "torch": str(torch.__version__), "config": net.config.to_dict(),
        "every": detector.every,
        "sizes": asdict(net.sizes), "prior": net.prior.to_dict(), "channels": net.channels,
        "threshold": asdict(detector.calibration), "notes": notes or {},
    }  # fmt: skip
    tensors = {k: t.detach().cpu().contiguous().clone() for k, t in net.state_dict().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
        save_file(tensors, part, {"format": FORMAT, "about": json.dumps(about)})


def load(path: str | os.PathLike[str], prior: PriorBox | None = None) -> WindowDetector:
    """Open a detector; with `prior`, one of another robot or prior is refused.

    Raises:
      InputError: the file is damaged, of another format, or of another robot or prior than asked for.
    """
    path = Path(path)
    tensors, metadata = read(path)
    require_format(path, metadata, FORMAT)
    try:
        about = json.loads(metadata["about"])
        own, sizes = PriorBox.from_dict(about["prior"]), Sizes(**about["sizes"])
        kind, config = _SCORERS[about.get("scorer", "contrast")]  # which earlier versions did not name
        net = kind(config(**about["config"]), sizes, own, tuple(about["channels"]))
        threshold, every = Threshold(**about["threshold"]), int(about["every"])
    except (KeyError, TypeError, ValueError) as e:
        raise InputError(f"{path}: its metadata describe no detector that this version knows ({e})") from None
    if prior is not None:
        prior.require_same(own, str(path))
    try:
        net.load_state_dict(tensors)
    except RuntimeError as e:
        raise InputError(f"{path}: its weights are not those of the detector that it describes ({e})") from None
    return WindowDetector(net.eval(), threshold, every)


def opened(path: Path) -> Any:
    """What a `.safetensors` file holds: a detector, or a posterior."""
    tensors, metadata = read(path)
    if metadata.get("format") == NORMAL:
        return NormalPosterior.of_file(path, tensors, metadata)
    return load(path) if metadata.get("format") == FORMAT else posterior.load(path)
