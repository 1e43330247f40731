"""Arguments that are whole numbers, or shares."""

from numbers import Integral
from typing import Any

from nfc_gym.core.errors import InputError


def require_whole(name: str, value: Any, least: int) -> int:
    """A whole number, `least` or more, of Python or numpy; anything else raises `InputError` with the name."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise InputError(f"{name} is {value!r}, want a whole number, {least} or more")
    return int(value)


def require_share(name: str, value: float) -> float:
    """A number from 0 to 1; anything else, nan too, raises `InputError` with the name."""
    if not 0 <= value <= 1:
        raise InputError(f"{name} is {value!r}, want a share from 0 to 1")
    return value
