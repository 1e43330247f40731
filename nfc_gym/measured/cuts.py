"""Where the segments of logs lie: at which rows they start, and which samples they are compared with."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Log
from nfc_gym.measured.channels import parse_channel
from nfc_gym.measured.smoothing import POINTS

Array = NDArray[np.float64]
_STEP, _SHARE = 8.0, 0.02  # times its usual change from row to row, and of its range, from which a command steps
_AROUND = 3  # rows on either side of a start from which its state is estimated
_SETTLED = 0.05  # s after a step in which late drives may still pass it on
_LATE = 0.1  # s by which a drive may well be late, or for which it lags
_IDLE = 0.1  # of their usual change, below which commands rest
_SPARSE = 2.0  # times as far apart as usual that the samples that tell a state may lie
_PUT_OFF = 0.5  # of a stride, at most, by which a start is put off
_LEFT = 0.5  # of a stride, left over at a log's end, for which one more segment pays


@dataclass(frozen=True)
class Layout:
    """How logs are cut.

    Attributes:
      length: s, of a segment.
      history: s of commands before its start.
      horizons: s after the start at which prediction and measurement are compared.
      stride: s between starts; the length where segments follow each other.
      dt: physics step, s.
      put_off: whether a start waits until no command steps beside it; not where states are known and not estimated.
      unknown: s from a log's beginning in which commands before it, of which it does not tell, are still felt by the
        model; no segment starts there, short of half the log. Nor while a late drive may be at them (`_unknown`).
    """

    length: float
    history: float
    horizons: tuple[float, ...]
    stride: float
    dt: float
    put_off: bool = True
    unknown: float = 0.0


@dataclass(frozen=True)
class Cut:
    """Where each of S segments lies in its log.

    Attributes:
      log: (S,) index of the log.
      start: (S,) sample at which the segment starts.
      samples: (S, h) sample nearest to each horizon.
      step: (S, h) the samples' times on the physics grid, in steps after the start (not whole numbers).
    """

    log: NDArray[np.intp]
    start: NDArray[np.intp]
    samples: NDArray[np.intp]
    step: Array


def _stepped(log: Log) -> NDArray[np.bool_]:
    """(T,) rows at which a command steps: changes by much more than it usually does from one row to the next."""
    out = np.zeros(len(log), bool)
    for values in log.controls.values():
        change, range_ = np.abs(np.diff(values)), np.ptp(values)
        out[1:] |= change > max(_STEP * float(np.median(change)), _SHARE * float(range_))
    return out


def _calm(log: Log) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(T,) rows whose state may be estimated from the rows around; and of these the ones that late drives suit too.

    Where a command steps so does the acceleration, and a smooth curve through the rows on both sides has a wrong slope
    there: always to the side of the command, as if a gain, an inertia or an offset were off.
    """
    rows, settled = np.flatnonzero(_stepped(log)), round(_SETTLED / log.interval)
    near, late = (_between(len(log), rows - _AROUND + 1, rows + _AROUND + more) for more in (0, settled))
    return ~near, ~late


def _unknown(log: Log, layout: Layout) -> float:
    """S from a log's beginning in which commands before it may still be felt.

    Of a machine that is logged in mid motion nobody knows what it was told last, and a drive that is late does that
    after the log has begun: a start there belies a delay that is as true as can be. Where commands rest as the log
    begins they will have rested before.
    """
    if log.inputs.time[0] < log.time[0] or not layout.put_off:
        return 0.0
    late, rows = min(_LATE, layout.history), log.time[1:] - log.time[0] <= _LATE + 1e-9
    change = [np.abs(np.diff(values)) for values in log.controls.values()]
    moving = any(c[rows].mean() > _IDLE * c.mean() for c in change if rows.any())
    return max(layout.unknown, late) if moving else layout.unknown


def _between(size: int, first: NDArray[np.intp], end: NDArray[np.intp]) -> NDArray[np.bool_]:
    """(size,) which rows lie in any of the stretches that begin at `first` and end before `end`."""
    edges = np.zeros(size + 1, int)
    np.add.at(edges, np.clip(first, 0, size), 1)
    np.add.at(edges, np.clip(end, 0, size), -1)
    return np.cumsum(edges[:-1]) > 0


def _put_off(log: Log, row: int, calm: tuple[NDArray[np.bool_], NDArray[np.bool_]], until: float) -> int:
    """The first calm row from a row on whose time is no later than `until`; the row itself where none is."""
    end = int(np.searchsorted(log.time, until + 1e-9, side="right"))
    for each in reversed(calm):
        found = np.flatnonzero(each[row:end])
        if len(found):
            return row + int(found[0])
    return row


def _seen(log: Log) -> NDArray[np.bool_]:
    """(T,) rows whose state is told by rows close by, in all channels that states come from.

    The cubics of states go through seven samples. Where these lie twice as far apart as they usually do, in a stretch
    that is masked, what a cubic cannot follow is no longer small beside the noise, and nothing tells how large it is.
    """
    out = np.ones(len(log), bool)
    for name, channel in log.channels.items():
        if channel.mask is None or parse_channel(name).kind not in ("joint", "body"):
            continue
        index = np.flatnonzero(channel.mask)
        if len(index) <= POINTS:
            continue
        first = np.clip(np.searchsorted(index, np.arange(len(log))) - POINTS // 2, 0, len(index) - POINTS)
        begin, end = log.time[index[first]], log.time[index[first + POINTS - 1]]
        span = np.maximum(end, log.time) - np.minimum(
            begin, log.time
        )  # before a first sample and behind a last one too
        out &= span <= _SPARSE * np.median(span[index])
    return out


def _onward(seen: NDArray[np.bool_], row: int) -> int:
    """The first row from a row on that is told by rows close by; the number of rows where none is."""
    found = np.flatnonzero(seen[row:])
    return row + int(found[0]) if len(found) else len(seen)


def _nearest(time: Array, at: Array) -> NDArray[np.intp]:
    """(n,) rows whose time (T,), which increases, is nearest to other times (n,); of two as near the earlier."""
    after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    return after - (at - time[after - 1] <= time[after] - at)


def _starts(log: Log, layout: Layout, last: float) -> Iterator[int]:
    """Rows at which segments start, end to end, none later than `last`, s.

    A start near which a command steps is put off to where its state can be told (`Layout.put_off`), and those behind it
    with it. So is one in a stretch that is masked, however long that is, unless every start of the log would be. Where
    half a segment or more would be left over at the end, one more ends there and shares the rest with the one before.
    """
    calm, seen, row = _calm(log), _told(log, layout, last), None
    for row in _in_turn(log, layout, last, calm, seen):
        yield row
    if row is not None and layout.put_off and seen[-1]:  # something is measured where it ends
        first = int(np.searchsorted(log.time, log.time[row] + _LEFT * layout.stride - 1e-9))
        end = int(np.searchsorted(log.time, last + 1e-9, side="right"))
        fit = np.flatnonzero((calm[0] & seen)[first : min(end, len(log) - 1)])
        if len(fit):
            yield first + int(fit[-1])


def _told(log: Log, layout: Layout, last: float) -> NDArray[np.bool_]:
    """(T,) rows whose state is told by rows close by; all where no start of the log would be."""
    seen = _seen(log)
    if not layout.put_off or not (seen & (log.time <= last + 1e-9)).any():
        seen[:] = True
    return seen


def _in_turn(
    log: Log, layout: Layout, last: float, calm: tuple[NDArray[np.bool_], NDArray[np.bool_]], seen: NDArray[np.bool_]
) -> Iterator[int]:
    """Rows at which segments start one behind the other."""
    late = min(_unknown(log, layout), max(last, 0.0) / 2)
    for number in count():
        begin = number * layout.stride + late
        if begin > last + 1e-9:
            return
        planned = int(np.searchsorted(log.time, begin - 1e-9))
        if planned >= len(log) - 1:  # the half interval that a log may be too short by reaches past its samples
            continue
        row = _onward(seen, planned)
        if row < len(log) - 1 and layout.put_off:
            row = _onward(seen, _put_off(log, row, calm, min(log.time[row] + _PUT_OFF * layout.stride, last)))
        if row > planned and not seen.all() and (row >= len(log) - 1 or log.time[row] > last + 1e-9):
            return
        late += float(log.time[row] - log.time[planned])
        yield row


def cut(logs: Sequence[Log], layout: Layout) -> Cut:
    """Place segments end to end in every log that is long enough; each holds a sample beside its start.

    Raises:
      InputError: no log holds even one segment.
    """
    which, starts, samples, steps = [], [], [], []
    for i, log in enumerate(logs):
        last = log.time[-1] - max(layout.horizons) + 0.5 * log.interval
        for row in _starts(log, layout, last):
            near = _nearest(log.time, log.time[row] + np.array(layout.horizons))
            if near.max() <= row:  # no sample lies as far after the start as any horizon
                continue
            which.append(i)
            starts.append(row)
            samples.append(near)
            steps.append((log.time[near] - log.time[row]) / layout.dt)
    if not which:
        raise _too_short(logs, layout)
    return Cut(np.array(which), np.array(starts), np.array(samples), np.array(steps))


def _too_short(logs: Sequence[Log], layout: Layout) -> InputError:
    """What to do where no log holds a segment."""
    longest, wanted = max(log.duration for log in logs), max(layout.horizons)
    if longest >= wanted:
        return InputError(
            f"no segment of {wanted:g} s holds a sample beside its start: they are "
            f"{min(log.interval for log in logs):.3g} s apart; check time.unit, or lengthen segments.length"
        )
    return InputError(
        f"no log is long enough for one segment of {wanted:g} s (the longest has {longest:.3g} s): "
        "shorten segments.length"
    )
