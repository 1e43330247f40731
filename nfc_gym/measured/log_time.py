"""The times of a log's rows: a column of the file, or rows a known interval apart where the log has no clock."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import InputError, units
from nfc_gym.measured.columns import LogColumns, plausible
from nfc_gym.measured.entries import TimeColumn
from nfc_gym.measured.readers import Streams

Array = NDArray[np.float64]

LARGEST_GAP = 10.0  # sampling intervals; a longer pause makes two logs of one


def require_no_streams(streams: Streams, entry: TimeColumn) -> None:
    """Refuse `interval` for a log whose topics have times of their own; raises `InputError` that names some."""
    if entry.interval is not None:
        clocks = ", ".join(sorted(f"{s.name}.time" for s in streams.streams)[:8])
        raise InputError(f"`interval` is for logs without a clock; this one has several, name one as column: {clocks}")


def time_of(entry: TimeColumn, columns: LogColumns, names: Iterable[str]) -> Array:
    """(T,) s from 0, increasing; from then on every column must have T rows.

    Args:
      entry: the mapping's `time`.
      columns: of the log.
      names: the columns that the mapping uses, by which rows without a clock are counted.

    Raises:
      InputError: no such column, one that is no time, a pause that makes two logs of one; columns of several lengths.
    """
    if entry.interval is not None:
        return np.arange(columns.untimed(names)).astype(np.float64) * entry.interval
    time = _of_column(entry.columns[0], entry.unit, columns)
    found = gaps(time)
    if len(found) and entry.gaps == "refuse":
        step = np.diff(time)
        longest = int(step.argmax())
        raise InputError(
            f"a gap of {step[longest]:.3g} s after row {longest}, at {time[longest]:.6g} s, where samples are "
            f"{np.median(step):.3g} s apart ({len(found)} such gap{'s' * (len(found) > 1)}); say `gaps: cut` under "
            "`time` to make a log of each stretch"
        )
    return time


def gaps(time: Array) -> NDArray[np.intp]:
    """Rows (g,) of increasing times (T,) after which the next one is late by more than sampling explains."""
    step = np.diff(time)
    return np.flatnonzero(step > LARGEST_GAP * np.median(step)) if len(step) else np.empty(0, np.intp)


def _of_column(name: str, unit: str, columns: LogColumns) -> Array:
    try:
        raw = columns.time(name)
    except InputError as e:
        hint = "" if name in columns else "; of a log without a clock say `interval`, the seconds from row to row"
        raise InputError(f"{e}{hint}") from None
    bad = np.flatnonzero(~np.isfinite(raw))
    if bad.size:
        raise InputError(f"column {name!r} is not a number at row {bad[0]}; remove such rows")
    plausible(raw, f"column {name!r}")
    time = units.to_si(raw - raw[0], unit)
    step = np.diff(time)
    back = np.flatnonzero(step <= 0)
    coarse = "or, if its stamps are rounded, save them whole or say `interval`, the seconds from row to row"
    if len(back) == len(step):
        raise InputError(f"column {name!r} never increases; name the column that holds the time, {coarse}")
    if back.size:
        k = int(back[0])
        received = f"{name.removesuffix('.time')}.received"
        how = "stands still" if step[k] == 0 else "goes back"
        raise InputError(
            f"column {name!r} {how} at row {k + 1} ({time[k]:.6g} to {time[k + 1]:.6g} s, "
            f"{back.size} such row{'s' * (back.size > 1)}); "
            f"remove repeated rows, cut the file there into two logs, {coarse}"
            + (f"; or name {received!r}, or the time of another topic" if received in columns else "")
        )
    return time
