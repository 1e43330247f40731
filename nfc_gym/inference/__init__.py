"""Neural inference of a simulator's fidelity: data, encoders, posteriors, anomaly detection. No MuJoCo here.

Needs the extra `inference`. Importing this package does not load torch; its names do.
"""

from typing import TYPE_CHECKING

from nfc_gym.core import lazy

if TYPE_CHECKING:
    from nfc_gym.inference.config import NetworkConfig, Sizes
    from nfc_gym.inference.contrast import Contrast, ContrastConfig
    from nfc_gym.inference.data import StoredWindows, TensorWindows
    from nfc_gym.inference.detector import Either, WindowDetector
    from nfc_gym.inference.faults import FaultClassifier, FaultConfig
    from nfc_gym.inference.jobs import infer, train_posterior
    from nfc_gym.inference.network import Network
    from nfc_gym.inference.normal import NormalPosterior
    from nfc_gym.inference.posterior import NeuralPosterior, Window, load
    from nfc_gym.inference.progress import Spoken
    from nfc_gym.inference.sequential import sequential
    from nfc_gym.inference.space import PriorBox
    from nfc_gym.inference.train import TrainConfig, train
    from nfc_gym.inference.windows import Windows

_HOME = {
    "Contrast": "contrast",
    "ContrastConfig": "contrast",
    "Either": "detector",
    "FaultClassifier": "faults",
    "FaultConfig": "faults",
    "Network": "network",
    "NetworkConfig": "config",
    "NeuralPosterior": "posterior",
    "NormalPosterior": "normal",
    "PriorBox": "space",
    "Sizes": "config",
    "Spoken": "progress",
    "StoredWindows": "data",
    "TensorWindows": "data",
    "TrainConfig": "train",
    "Window": "posterior",
    "WindowDetector": "detector",
    "Windows": "windows",
    "infer": "jobs",
    "load": "posterior",
    "sequential": "sequential",
    "train": "train",
    "train_posterior": "jobs",
}
__all__ = [
    "Contrast", "ContrastConfig", "Either", "FaultClassifier", "FaultConfig", "Network", "NetworkConfig",
    "NeuralPosterior", "NormalPosterior", "PriorBox", "Sizes", "Spoken", "StoredWindows", "TensorWindows",
    "TrainConfig", "Window", "WindowDetector", "Windows", "infer", "load", "sequential", "train", "train_posterior",
]  # fmt: skip

lazy.export(__name__, _HOME, "inference")
