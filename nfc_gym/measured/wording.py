"""Numbers, units and lists as a person writes them: sensible digits, a dash where there is nothing to say."""

import math
from collections.abc import Sequence
from typing import Any

from nfc_gym.physics.effects.words import together

DASH = "–"
_MINUS = "−"
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_LARGE, _SMALL = 1e5, 1e-3  # beyond these a power of ten reads better than zeros


def finite(value: Any) -> float | None:
    """The value as a float, or None where it is missing, not a number or infinite."""
    if value is None or isinstance(value, str | bool):
        return None
    try:
        out = float(value)
    except (TypeError, ValueError):
        return None
    return out if math.isfinite(out) else None


def number(value: Any, digits: int = 3) -> str:
    """A number to so many significant digits: `0.0123`, `1.20×10⁶`, or a dash where there is none."""
    x = finite(value)
    if x is None:
        return DASH
    if x == 0:
        return "0"
    mantissa, _, power = f"{x:.{digits - 1}e}".partition("e")
    exponent = int(power)
    if not _SMALL <= abs(float(f"{mantissa}e{power}")) < _LARGE:
        return f"{mantissa}×10{str(exponent).translate(_SUPERSCRIPT)}".replace("-", _MINUS)
    return fixed(x, max(digits - 1 - exponent, 0))


def plain(value: Any) -> str:
    """A number that somebody chose, such as a horizon: no zeros added, `0.4`."""
    x = finite(value)
    return DASH if x is None else f"{x:.6g}".replace("-", _MINUS)


def fixed(x: float, places: int) -> str:
    """So many places after the point, with a real minus sign and no negative zero."""
    text = f"{x:.{places}f}"
    return text.lstrip("-") if float(text) == 0 else text.replace("-", _MINUS)


def interval(value: Any, low: Any, high: Any) -> tuple[str, str]:
    """A value and `low to high`, all to the place where the interval's half-width has its second digit."""
    x, a, b = finite(value), finite(low), finite(high)
    if x is None or a is None or b is None:
        return number(x), DASH if a is None and b is None else f"{number(a)} to {number(b)}"
    half, largest = abs(b - a) / 2, max(abs(x), abs(a), abs(b))
    if half == 0 or largest >= _LARGE or largest < _SMALL:
        return number(x), f"{number(a)} to {number(b)}"
    places = min(max(1 - math.floor(math.log10(half)), 0), 6)
    return fixed(x, places), f"{fixed(a, places)} to {fixed(b, places)}"


def unit(name: Any) -> str:
    """A unit for display; dimensionless (`1`) is empty."""
    return "" if name in (None, "", "1") else str(name)


def quantity(value: Any, name: Any, digits: int = 3) -> str:
    """A number with its unit, held together by a space that does not break; a dash alone where there is none."""
    shown = number(value, digits)
    return shown if shown == DASH or not unit(name) else f"{shown}\N{NO-BREAK SPACE}{unit(name)}"


def percent(share: Any) -> str:
    """A share as a percentage: `93 %`, `under 1 %`, or a dash."""
    x = finite(share)
    if x is None:
        return DASH
    if 0 < x < 0.01:
        return "under\N{NO-BREAK SPACE}1\N{NO-BREAK SPACE}%"
    return f"{fixed(100 * x, 0)}\N{NO-BREAK SPACE}%"


def change(nominal: Any, estimate: Any) -> str:
    """Relative change as `+4.2 %`; a dash where the nominal is zero or missing."""
    a, b = finite(nominal), finite(estimate)
    if a is None or b is None or a == 0:
        return DASH
    x = 100 * (b - a) / abs(a)
    text = fixed(x, 1 if abs(x) < 10 else 0)
    return f"{'+' if x > 0 and float(text.replace(_MINUS, '-')) else ''}{text}\N{NO-BREAK SPACE}%"


def listed(names: Sequence[Any], most: int = 6) -> str:
    """`a, b and c`; beyond `most` the rest is counted."""
    words = [str(n) for n in names]
    if not words:
        return DASH
    if len(words) > most:
        words = [*words[: most - 1], f"{len(words) - most + 1} more"]
    return together(words)


def counted(n: int, one: str, many: str | None = None) -> str:
    """`1 log`, `3 logs`."""
    return f"{n} {one if n == 1 else many or one + 's'}"


_BY = {
    "generic_position": "position",
    "generic_velocity": "speed",
    "generic_time": "time",
    "generic_memory": "its past",
}


def smooth(generic: str) -> str:
    """A generic law's id in words."""
    family, _, joint = generic.partition(":")
    return f"a smooth force by {_BY[family]} at {joint}"
