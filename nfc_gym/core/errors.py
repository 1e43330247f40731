"""The package's errors: one root, and one class for each thing a caller can do about it."""


class NfcError(Exception):
    """Root of every error that this package raises on purpose."""


class InputError(NfcError, ValueError):
    """What the user gave cannot be used: the message names the value and says what would be valid."""


class MissingExtra(NfcError, ImportError):
    """A capability was asked for whose optional dependencies are not installed; the message names the extra."""
