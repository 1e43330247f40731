"""One table of units: what a log may be given in, and the SI unit it becomes."""

import re
from difflib import get_close_matches

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nfc_gym.core.errors import InputError

_TURN = 2 * np.pi
_STANDARD_GRAVITY = 9.80665  # m/s^2, CGPM 1901

# unit -> (SI unit, factor, offset): value in SI = value * factor + offset
_TABLE: dict[str, tuple[str, float, float]] = {
    "1": ("1", 1.0, 0.0),
    "%": ("1", 0.01, 0.0),
    "s": ("s", 1.0, 0.0),
    "ms": ("s", 1e-3, 0.0),
    "us": ("s", 1e-6, 0.0),
    "ns": ("s", 1e-9, 0.0),
    "rad": ("rad", 1.0, 0.0),
    "deg": ("rad", _TURN / 360, 0.0),
    "rad/s": ("rad/s", 1.0, 0.0),
    "deg/s": ("rad/s", _TURN / 360, 0.0),
    "rpm": ("rad/s", _TURN / 60, 0.0),
    "rad/s^2": ("rad/s^2", 1.0, 0.0),
    "deg/s^2": ("rad/s^2", _TURN / 360, 0.0),
    "m": ("m", 1.0, 0.0),
    "mm": ("m", 1e-3, 0.0),
    "cm": ("m", 1e-2, 0.0),
    "m/s": ("m/s", 1.0, 0.0),
    "m/s^2": ("m/s^2", 1.0, 0.0),
    "g": ("m/s^2", _STANDARD_GRAVITY, 0.0),
    "N": ("N", 1.0, 0.0),
    "Nm": ("N m", 1.0, 0.0),
    "N m": ("N m", 1.0, 0.0),
    "V": ("V", 1.0, 0.0),
    "A": ("A", 1.0, 0.0),
    "kg": ("kg", 1.0, 0.0),
    "kg m^2": ("kg m^2", 1.0, 0.0),
    "K": ("K", 1.0, 0.0),
    "degC": ("K", 1.0, 273.15),
    "Pa": ("Pa", 1.0, 0.0),
}
UNITS = tuple(_TABLE)
_NAMES = re.compile(r"[^\W\d]+")
_COHERENT = {"s", "rad", "m", "N", "Nm", "V", "A", "kg", "K", "Pa", "W", "J", "Hz"}


def known(unit: str) -> bool:
    """Whether `unit` is in the table."""
    return unit in _TABLE


def coherent(unit: str) -> bool:
    """Whether `unit` is SI as it stands, a product of powers of base units included, or "1" or "own unit"."""
    if unit in _TABLE:
        return _TABLE[unit] == (unit, 1.0, 0.0)
    return unit == "own unit" or set(_NAMES.findall(unit)) <= _COHERENT


def si_unit(unit: str) -> str:
    """The SI unit that `unit` is converted to; an unknown unit raises `InputError` listing the known ones."""
    return _row(unit)[0]


def to_si(values: ArrayLike, unit: str) -> NDArray[np.float64]:
    """Values in `unit`, any shape, in SI: `to_si(180, "deg")` is pi. Raises `InputError` for an unknown unit."""
    _, factor, offset = _row(unit)
    return np.asarray(values, np.float64) * factor + offset


def from_si(values: ArrayLike, unit: str) -> NDArray[np.float64]:
    """The inverse of `to_si`: `from_si(pi, "deg")` is 180."""
    _, factor, offset = _row(unit)
    return (np.asarray(values, np.float64) - offset) / factor


def change_from_si(changes: ArrayLike, unit: str) -> NDArray[np.float64]:
    """Differences of SI values, any shape, in `unit`: scaled, but not shifted."""
    return np.asarray(changes, np.float64) / _row(unit)[1]


def spread_to_si(deviation: float, unit: str) -> float:
    """A standard deviation in `unit`, in SI: scaled, but not shifted as a temperature in degC would be."""
    return deviation * _row(unit)[1]


_SPELT = {
    "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad", "meter": "m", "meters": "m", "metre": "m",
    "metres": "m", "millimeters": "mm", "millimetres": "mm", "second": "s", "seconds": "s", "milliseconds": "ms",
    "newton": "N", "newtons": "N", "volt": "V", "volts": "V", "ampere": "A", "amperes": "A",
}  # fmt: skip


def spelt(unit: str) -> str:
    """The symbol of a unit whose name is written out; anything else as it is."""
    return _SPELT.get(unit.lower(), unit)


def _row(unit: str) -> tuple[str, float, float]:
    if unit not in _TABLE:
        close = get_close_matches(spelt(unit), UNITS, 1)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise InputError(f"unknown unit {unit!r}; {hint}known units: {', '.join(UNITS)}")
    return _TABLE[unit]
