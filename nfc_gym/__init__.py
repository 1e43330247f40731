"""nfc_gym: find what a MuJoCo model of a robot lacks from logs of the real machine, and put it there.

Importing this package needs the core dependencies alone: neither torch nor a plotting or table library is loaded.
"""

from nfc_gym.core import Channel, InputError, Log, MissingExtra, NfcError, SimulationUnstable
from nfc_gym.envs import registry

__version__ = "0.1.0"

registry.register()  # `import nfc_gym` is what makes `gymnasium.make("nfc_gym/...")` know the ids

__all__ = ["Channel", "InputError", "Log", "MissingExtra", "NfcError", "SimulationUnstable", "__version__"]
