"""Clock offsets that the mapping names (`shift`), taken out of a log whose columns share one clock.

A sample stamped t was taken at t - shift. Shifted columns are interpolated from there to the log's rows, orientations
by slerp; of a column that is held between renewals only the renewals are samples, and the row nearest to each is kept.
Rows that a shifted column does not reach are left out. Logs of several clocks are `align`'s.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import InputError
from nfc_gym.measured.align import Use, shifted
from nfc_gym.measured.columns import LogColumns
from nfc_gym.measured.readers import Table
from nfc_gym.measured.resampling import flagged, interpolated, nearest_rows
from nfc_gym.measured.smoothing import fresh_samples

Array = NDArray[np.float64]


def too_long(shifts: Mapping[str, float], duration: float) -> Iterator[tuple[str, str]]:
    """(channel, what is wrong) for each shift that would leave nothing of a log of `duration` s."""
    for name, shift in shifts.items():
        if abs(shift) >= duration:
            text = f"{shift:g} s is no shorter than the log, {duration:.4g} s"
            yield name, f"{text}; it is in seconds, positive where the channel's stamps are late"


def shift_table(table: Table, time: Array, uses: Sequence[Use]) -> tuple[Table, Array]:
    """A table with its shifted columns beside the others, under the name `align.shifted`.

    Args:
      table: columns of T rows, or constants.
      time: (T,) s, increasing.
      uses: of the mapping's columns. One whose columns cannot be used is left out, to be told where it is used.

    Returns:
      The table, with the rows that every shifted column reaches, and their times, from 0.

    Raises:
      InputError: fewer than two rows are left.
    """
    uses = [use for use in uses if use.shift]
    if not uses:
        return table, time
    stamps = {use.shift: time - use.shift for use in uses}
    first, last = max(s[0] for s in stamps.values()), min(s[-1] for s in stamps.values())
    rows = (time >= first) & (time <= last)
    if rows.sum() < 2:
        raise InputError(f"the shifts, {', '.join(f'{s:g} s' for s in stamps)}, leave fewer than two rows of the log")
    grid, columns = time[rows], LogColumns(table, len(time))
    out: Table = {name: v[rows] if np.ndim(v) and len(v) == len(time) else v for name, v in table.items()}
    for use in uses:
        with suppress(InputError):
            out |= _moved(columns, use, stamps[use.shift], grid)
    return out, grid - grid[0]


def _moved(columns: LogColumns, use: Use, stamps: Array, grid: Array) -> Table:
    names = [shifted(name, use.shift) for name in use.columns]
    if use.how == "both":
        return {names[0]: flagged(stamps, columns.one(use.columns[0])[:, None], grid)[:, 0]}
    parts = [columns.many((name,)) for name in use.columns]
    values = np.concatenate(parts, 1)
    samples = fresh_samples(stamps, values, use.rate)
    # Pauses are bridged: a longer one than what the log's time may have is refused before, and renewals that repeat a
    # value are not seen.
    moved = interpolated(stamps[samples], values[samples], grid, np.inf, use.how == "slerp", use.turn)
    if len(samples) < len(stamps):
        moved[~nearest_rows(stamps[samples], grid)] = np.nan
    ends = np.cumsum([part.shape[1] for part in parts])
    return dict(zip(names, np.split(moved, ends[:-1], axis=1), strict=True))
