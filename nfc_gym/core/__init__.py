"""Plain data that every other part may import: logs, fidelities, posteriors, errors. Needs numpy alone."""

from nfc_gym.core.errors import InputError, MissingExtra, NfcError
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.core.log import Channel, Log
from nfc_gym.core.posterior import Posterior, Sampler, load_source, register_loader, without_maps

__all__ = [
    "Channel",
    "Fidelity",
    "InputError",
    "Log",
    "MissingExtra",
    "NfcError",
    "Posterior",
    "Sampler",
    "load_source",
    "register_loader",
    "without_maps",
]
