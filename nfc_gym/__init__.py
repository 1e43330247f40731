"""nfc_gym: find what a MuJoCo model of a robot lacks from logs of the real machine, and put it there.

Importing this package needs the core dependencies alone: neither torch nor a plotting or table library is loaded.
"""

from pathlib import Path

from nfc_gym.core import (
    Channel,
    InputError,
    Log,
    MissingExtra,
    NfcError,
    Sampler,
    register_loader,
)
from nfc_gym.envs import registry

__version__ = "0.1.0"

registry.register()  # `import nfc_gym` is what makes `gymnasium.make("nfc_gym/...")` know the ids


def _open_posterior(path: Path) -> Sampler:
    """A checkpoint of a neural posterior or of an anomaly detector; torch is loaded only now."""
    try:
        from nfc_gym.inference.detector_file import opened
    except ImportError as e:
        raise MissingExtra(f"{path}: a network needs {e.name}: pip install 'nfc_gym[inference]'") from None
    return opened(path)


register_loader(".safetensors", _open_posterior)  # wherever a source may be a path, it may be a posterior

__all__ = ["Channel", "InputError", "Log", "MissingExtra", "NfcError", "__version__"]
