"""Arguments that are numbers, whole numbers, or shares."""

from math import isfinite
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError


def is_number(value: Any) -> bool:
    """Whether it is one finite number, of Python or numpy; a flag is none."""
    try:
        return isinstance(value, Real) and not isinstance(value, bool) and isfinite(value)
    except OverflowError:  # a whole number beyond any float
        return False


def real_array(value: Any) -> NDArray[np.float64] | None:
    """A number, or numbers, as an array; None for text, flags, complex numbers and ragged lists."""
    try:
        given = np.asarray(value)
        return given.astype(np.float64, copy=False) if given.dtype.kind in "fiuO" else None
    except (TypeError, ValueError, OverflowError):
        return None


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
