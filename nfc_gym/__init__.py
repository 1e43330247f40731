"""nfc_gym: simulated robots, what their simulator lacks of the real machine, and policies that cope with it.

Environments: `import nfc_gym`, then `gymnasium.make("nfc_gym/JackalFlat-v0")` or `gymnasium.make_vec`: Ant, Humanoid,
Quadruped, Quadcopter and Jackal, on Flat and on Rough ground. What is believed of their physics and of the terrain is
part of what they observe.

Wrappers (`nfc_gym.wrappers`): effects, drawn or inferred physics, terrain, noisy signals, alarms and logs, around these
and any other MuJoCo environment.

Logs (`nfc_gym.measured`): from logs of the real machine, calibrate a MuJoCo model, find which effect it lacks, put it
there, and say what to record next.

Posteriors (`nfc_gym.simulate`, `nfc_gym.inference`): networks that infer the physics from a window of motion, and
detectors of what is not normal, trained on simulations.

Policies (`nfc_gym.adaptation`): pretrain by PPO under random physics, adapt to what was found, on a mission or from
logs. One comes with the package for each environment.
"""

# Importing this package needs the core dependencies alone: neither torch nor a plotting or table library is loaded.

from pathlib import Path

from nfc_gym.core import (
    Channel,
    Fidelity,
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

__all__ = ["Channel", "Fidelity", "InputError", "Log", "MissingExtra", "NfcError", "__version__"]
