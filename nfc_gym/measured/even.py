"""Time stamps that scatter about even rows: whether the samples were taken evenly is asked of what was measured.

A computer stamps a sample when it gets to it, and a timer may have taken it at an even beat all the same; or the stamps
are right and the sampling is uneven. The motion is smooth either way, and tells: at the right times the measurements
lie nearer to smooth curves. A joint at 5 rad/s whose stamps are off by 0.1 ms seems to be off by 5e-4 rad, more than
most encoders are, and its speed by far more than they make it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.log_time import gaps
from nfc_gym.measured.smoothing import local_polynomial, moving_average

Array = NDArray[np.float64]

_FEWEST = 100  # rows from which on it is asked
_WIDE = 51  # rows over which a clock's drift is followed
_LEAST, _MOST = 2e-3, 0.3  # of an interval: what stamps scatter by, to be asked about, and to be rounded to even rows
_CLEARLY = 1.2  # times nearer to smooth curves that some channel must be in even rows
_NO_WORSE = 1.02  # times farther that any other may be


@dataclass(frozen=True)
class Evened:
    """Times of rows that were sampled evenly, whatever their stamps say.

    Attributes:
      time: (T,) s.
      scatter: s, standard deviation of the stamps about them.
      interval: s, of the even rows.
      nearer: by which factor the measurements are nearer to smooth curves so, in the channel that shows it most.
    """

    time: Array
    scatter: float
    interval: float
    nearer: float


def evened(time: Array, channels: Sequence[Array]) -> Evened | None:
    """Even rows in place of scattering stamps, where the measurements say that they were taken so; None elsewhere.

    Args:
      time: (T,) s, increasing.
      channels: what was measured at each row, (T, k) each; NaN where nothing was.
    """
    if len(time) < _FEWEST or len(gaps(time)) or not channels:
        return None
    even, interval = _even(time)
    off = time - even
    scatter = float(off[_WIDE // 2 : -(_WIDE // 2)].std())
    if not _LEAST * interval < scatter < _MOST * interval or (np.diff(even) <= 0).any():
        return None
    nearer = [_roughness(time, c) / max(_roughness(even, c), 1e-300) for c in channels if _usable(c)]
    if not nearer or max(nearer) < _CLEARLY or min(nearer) < 1 / _NO_WORSE:
        return None
    return Evened(even - even[0], scatter, interval, max(nearer))


def _even(time: Array) -> tuple[Array, float]:
    """Times (T,) s in even rows, lost ones counted, that follow a clock's drift; and their interval, s."""
    step = np.diff(time)
    rows = np.concatenate([[0], np.cumsum(np.maximum(np.rint(step / np.median(step)), 1))])
    interval, begin = np.polyfit(rows, time, 1)
    off = time - (begin + interval * rows)
    return begin + interval * rows + moving_average(off, _WIDE), float(interval)


def _usable(channel: Array) -> bool:
    return bool(np.isfinite(channel).all() and np.ptp(channel, axis=0).any())


def _roughness(time: Array, channel: Array) -> float:
    """By how much samples are off cubics through seven of them, root mean square."""
    return float(np.sqrt(np.square(local_polynomial(time, channel, time).misfit).mean()))
