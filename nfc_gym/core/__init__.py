"""Plain data that every other part of the package may import: logs and errors. Needs numpy alone."""

from nfc_gym.core.errors import InputError, MissingExtra, NfcError, SimulationUnstable
from nfc_gym.core.log import Channel, Log

__all__ = ["Channel", "InputError", "Log", "MissingExtra", "NfcError", "SimulationUnstable"]
