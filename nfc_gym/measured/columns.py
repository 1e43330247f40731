"""From a file's table to the columns that a mapping names: addressing, broadcasting, and what may not be used."""

import re
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import InputError
from nfc_gym.measured.readers import Table
from nfc_gym.measured.yaml_marks import suggest

Array = NDArray[np.float64]
_INDEXED = re.compile(r"^(.+)\[(\d+)\]$")
_LARGEST = 1e20  # in any unit; nanoseconds since 1970 are 1.8e18


class LogColumns:
    """The columns of one log file.

    Every method raises `InputError` for a column that is missing, not numeric or of another length.

    Args:
      table: what the reader gave.
      rows: of the log, where they are known.
    """

    def __init__(self, table: Table, rows: int = 0) -> None:
        self._table = table
        self.rows = rows

    def __contains__(self, name: str) -> bool:
        return name in self._table

    def time(self, name: str) -> Array:
        """The time column (T,), in the file's unit; from then on every column must have T rows."""
        values = self._numbers(name, self._find(name))
        if values.ndim != 1 or len(values) < 2:
            raise InputError(f"time column {name!r} must be a vector of two or more samples")
        self.rows = len(values)
        return values

    def untimed(self, names: Iterable[str]) -> int:
        """The rows of a log without a time column, by the columns of these names that are there and no constants."""
        lengths: dict[str, int] = {}
        for name in names:
            try:
                values = self._find(name)
            except InputError:  # told where it is used
                continue
            if values.size > 1:
                lengths[name] = len(values)
        if max(lengths.values(), default=0) < 2:
            raise InputError("no column has two or more samples")
        first, rows = next(iter(lengths.items()))
        other = next((name for name, n in lengths.items() if n != rows), None)
        if other is not None:
            raise InputError(
                f"column {first!r} has {rows} rows and {other!r} {lengths[other]}; `interval` wants as many of each"
            )
        self.rows = rows
        return rows

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
                comma = re.fullmatch(r"\s*[-+]?\d+,\d+\s*", str(value))
                hint = "; save it with decimal points" if comma else ""
                raise InputError(f"column {name!r} is not numeric: row {row} holds {str(value)[:40]!r}{hint}") from None
        return values.astype(np.float64)

    def _rows(self, name: str) -> Array:
        values = self._numbers(name, self._find(name))
        if values.size == 1:
            return np.full(self.rows, values.item())
        if values.ndim not in (1, 2) or len(values) != self.rows or values.size == 0:
            across = values.ndim == 2 and values.shape[1] == self.rows
            hint = "; turn it over (transpose it), so that each sample is a row" if across else ""
            raise InputError(f"column {name!r} has shape {values.shape} where time has {self.rows} rows{hint}")
        return values


def finite(values: Array, what: str, needed: NDArray[np.bool_] | None = None) -> Array:
    """The values, if every one of the rows (or of the `needed` ones) is a number that something can have measured."""
    bad: NDArray[np.bool_] = np.asarray(~np.isfinite(values.reshape(len(values), -1)).all(1))
    if needed is not None:
        bad &= needed
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise InputError(
            f"{what}: {int(bad.sum())} of {len(bad)} rows {'are' if bad.sum() > 1 else 'is'} NaN or infinite, "
            f"the first row {row}; cut the log there, or, if it is measured and no command, say `rate` if its sensor "
            "is slower than the log, or name a `mask` column that is false in those rows"
        )
    return plausible(values, what)


def plausible(values: Array, what: str) -> Array:
    """The values, if none is larger than anything that is measured."""
    wild = np.argwhere(np.abs(np.where(np.isfinite(values), values, 0.0)) > _LARGEST)
    if len(wild):
        row = wild[0]
        raise InputError(
            f"{what}: {values[tuple(row)]:.3g} at row {row[0]} ({len(wild)} such value{'s' * (len(wild) > 1)}), "
            "which nothing measures; correct the column or its unit, or leave out those rows"
        )
    return values
