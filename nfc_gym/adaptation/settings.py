"""Settings that are numbers."""

import math
from numbers import Real
from typing import Any

from nfc_gym.core.errors import InputError


def require_number(name: str, value: Any, least: float, most: float = math.inf, what: str = "a number") -> float:
    """A finite number between two, both allowed, of Python or numpy; else raises `InputError` with name and meaning."""
    number = float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    if not math.isfinite(number) or not least <= number <= most:
        said = f"{least:g} or more" if most == math.inf else f"from {least:g} to {most:g}"
        raise InputError(f"{name} is {value!r}; want {what}, {said}")
    return number
