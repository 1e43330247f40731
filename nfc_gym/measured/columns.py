"""From a file's table to the columns that a mapping names: addressing, broadcasting, and what may not be used."""

import re

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import InputError
from nfc_gym.measured.readers import Table
from nfc_gym.measured.yaml_marks import suggest

Array = NDArray[np.float64]
_INDEXED = re.compile(r"^(.+)\[(\d+)\]$")


class LogColumns:
    """The columns of one log file.

    Every method raises `InputError` for a column that is missing, not numeric or of another length.

    Args:
      table: what the reader gave.
    """

    def __init__(self, table: Table) -> None:
        self._table = table
        self.rows = 0

    def time(self, name: str) -> Array:
        """The time column (T,), in the file's unit; from then on every column must have T rows."""
        values = self._numbers(name, self._find(name))
        if values.ndim != 1 or len(values) < 2:
            raise InputError(f"time column {name!r} must be a vector of two or more samples")
        self.rows = len(values)
        return values

    def one(self, name: str) -> Array:
        """One column (T,) of numbers; a scalar stands for every row."""
        values = self._rows(name)
        if values.ndim == 2 and values.shape[1] > 1:
            last = values.shape[1] - 1
            raise InputError(f"column {name!r} is {values.shape[1]} wide; name one as {name}[0] to {name}[{last}]")
        return values.reshape(self.rows)

    def many(self, names: tuple[str, ...]) -> Array:
        """LogColumns side by side, (T, k); a name of a two-dimensional array stands for all its columns."""
        return np.concatenate([self._rows(name).reshape(self.rows, -1) for name in names], axis=1)

    def product(self, names: tuple[str, ...], scale: float) -> Array:
        """The columns' product times `scale`, (T,)."""
        return scale * np.prod([self.one(name) for name in names], axis=0) * np.ones(self.rows)

    def mask(self, name: str) -> NDArray[np.bool_]:
        """A column of truth values, (T,): booleans, or the numbers 0 and 1."""
        values = self.one(name)
        odd = ~np.isin(values, (0.0, 1.0))
        if odd.any():
            row = int(np.flatnonzero(odd)[0])
            raise InputError(f"mask {name!r} holds {values[row]:g} at row {row}; want booleans, or 0 and 1")
        return values.astype(bool)

    def _find(self, name: str) -> NDArray:
        if name in self._table:
            return self._table[name]
        indexed = _INDEXED.match(name)
        if indexed and indexed[1] in self._table:
            array, index = self._table[indexed[1]], int(indexed[2])
            if array.ndim != 2:
                raise InputError(f"{indexed[1]!r} has {array.ndim} dimensions, so {name!r} is nothing; name it plainly")
            if index >= array.shape[1]:
                raise InputError(f"{name!r}: the array has columns 0 to {array.shape[1] - 1}")
            return array[:, index]
        raise InputError(f"no column {name!r}; {suggest(name, list(self._table))}")

    def _numbers(self, name: str, values: NDArray) -> Array:
        if values.dtype.kind in "biuf":
            return values.astype(np.float64)
        if values.dtype.kind == "c":
            raise InputError(f"column {name!r} holds complex numbers; save what is measured as real ones")
        try:
            return np.array([np.nan if v is None else v for v in values.ravel()], np.float64).reshape(values.shape)
        except (TypeError, ValueError):
            pass
        for row, value in enumerate(values.ravel()):
            try:
                float(value)
            except (TypeError, ValueError):
                raise InputError(f"column {name!r} is not numeric: row {row} holds {str(value)[:40]!r}") from None
        return values.astype(np.float64)

    def _rows(self, name: str) -> Array:
        values = self._numbers(name, self._find(name))
        if values.size == 1:
            return np.full(self.rows, values.item())
        if values.ndim not in (1, 2) or len(values) != self.rows or values.size == 0:
            raise InputError(f"column {name!r} has shape {values.shape} where time has {self.rows} rows")
        return values
