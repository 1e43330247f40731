"""Streams of a log brought to the times of one of them, the base, which the mapping's `time` column names.

Measured signals are interpolated linearly, orientations by slerp, commands held from the last one unless their `hold`
says linear. A gap longer than `GAP` of a stream's own sampling intervals is not bridged: rows inside it are NaN. Of a
sensor that is slower than the base only the row nearest to each of its samples is kept, so that one sample counts once.
Rows that some stream does not reach are cut off at both ends. A channel's `shift` is taken from its stamps before all
that. All of it is told by `Alignment`, nothing is guessed. A stream whose clock was set back while it was recorded is
refused: sorted by its stamps, two stretches of it would lie in each other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import InputError, units
from nfc_gym.measured.mapping import Mapping
from nfc_gym.measured.readers import Stream, Streams, Table
from nfc_gym.measured.resampling import (
    Clock,
    flagged,
    held,
    interpolated,
    lateness,
    nearest_rows,
    set_back,
    wandering,
)

Array = NDArray[np.float64]
How = Literal["linear", "hold", "slerp", "both"]

GAP = 4.0  # sampling intervals of a stream; over a longer pause nothing is interpolated
SLOWER = 1.5  # a sensor whose interval is so many times the base's is kept at its own samples only


@dataclass(frozen=True)
class Use:
    """Columns of the mapping that are resampled together.

    Attributes:
      columns: their names.
      how: interpolated, held, or of a shifted mask, which is true only between `both` true samples.
      measured: or commanded.
      shift: s by which their stamps are late.
      rate: Hz at which they are renewed where they are held between rows, if that was declared.
      beside: the channel's columns that a shifted mask is of; it moves with them if it has their clock.
      turn: of angles, a full turn in the unit of the columns.
    """

    columns: tuple[str, ...]
    how: How
    measured: bool = False
    shift: float = 0.0
    rate: float | None = None
    beside: tuple[str, ...] = ()
    turn: float | None = None


@dataclass(frozen=True)
class Resampled:
    """What was done to a stream.

    Attributes:
      stream: the topic.
      clock: what its times are.
      how: interpolated or held.
      rate, base_rate: Hz, before and after.
      gap: s, the longest pause that is bridged; infinite where values are held.
      missing: share of its rows that fell into longer pauses.
      kept: share of the base's rows that carry a sample of a sensor slower than the base; else 1.
      late: s, by which a held command comes after its stamp, on average: it waits for the base's next row.
      longest: s, the longest pause in it.
      silent: s, for which commands that come at a beat otherwise stayed away, and the last was held; 0 if they did not.
      repeated, disordered: samples with a stamp that another has, and those that came before an earlier one.
      shift: s that were taken from its stamps.
    """

    stream: str
    clock: str
    how: How
    rate: float
    base_rate: float
    gap: float
    missing: float
    kept: float
    late: float
    longest: float
    silent: float
    repeated: int
    disordered: int
    shift: float


@dataclass(frozen=True)
class Alignment:
    """A log's columns at the base's times.

    Attributes:
      table: every column that the mapping uses has the base's rows; the others are as they were. Columns whose stamps
        were shifted are there under the name `shifted`.
      base: the topic whose times they are.
      clock: what those times are.
      resampled: what was done to the other streams.
      rates: measured columns that are NaN in some rows, in gaps or between a slow sensor's samples -> Hz of those.
      ahead: s by which the stamps of a stream, its shift taken out, lie after its receipt, if they do, which two right
        clocks cannot show.
      wandering: s by which the stamps of a stream move against its receipt in the course of the log.
      cut: s that were cut off at the start and at the end, as some stream does not reach there.
      cutters: the streams that decided where.
    """

    table: Table
    base: str
    clock: str
    resampled: tuple[Resampled, ...]
    rates: dict[str, float]
    ahead: dict[str, float]
    wandering: dict[str, float]
    cut: tuple[float, float]
    cutters: tuple[str, str]


def shifted(name: str, shift: float) -> str:
    """The name of a column whose stamps were shifted by so many seconds; others keep theirs."""
    return f"{name} (shift {shift!r} s)" if shift else name


def uses(mapping: Mapping) -> list[Use]:
    """How each column of a mapping is brought to other times: commands and masks held, measurements interpolated."""
    found = [Use(c.columns, "hold" if c.hold == "zero" else "linear") for c in mapping.controls.values()]
    for c in mapping.channels.values():
        how = "slerp" if c.order is not None else "linear"
        turn = float(units.from_si(2 * np.pi, c.unit)) if c.unit and units.si_unit(c.unit) == "rad" else None
        found.append(Use(c.columns, how, True, c.shift, c.rate, turn=turn))
        if c.mask:
            mask = Use((c.mask,), "hold")
            found.append(replace(mask, how="both", shift=c.shift, beside=c.columns) if c.shift else mask)
    found += [Use(e.columns, "linear") for e in mapping.exogenous.values()]
    found += [Use((name,), "linear") for k in mapping.known for name in k.columns]
    servos = [c.servo for c in mapping.controls.values() if c.servo]
    return found + [Use((n,), "linear") for s in servos for t in (s.gain, s.supply, s.damping) for n in t.columns]


def align(streams: Streams, time: str, uses: Sequence[Use]) -> Alignment:
    """Bring the columns in `uses` to the times of column `time`.

    Raises:
      InputError: `time` is no stream's time, streams have no time in common, a stream's clock was set back, or a
        quaternion's columns have several clocks.
    """
    _require_present(streams, [time, *(c for use in uses for c in use.columns)])
    found = streams.clock(time)
    if found is None:
        return _single(streams, time, uses)
    base, kind = found
    grid = streams.seconds(base, kind)
    uses = [_own_clock(streams, use) for use in uses]
    owners = [(use, owner) for use in uses if (owner := _owner(streams, use)) is not None]
    others = {_label(s, use): (s, use.shift) for use, s in owners if s is not base or use.shift}
    if kind == "stamps":
        _require_forward(streams, base, [s for _, s in owners if s is not base])
    clocks = {n: Clock(streams.seconds(s, kind) - shift) for n, (s, shift) in others.items() if len(s.stamps) > 1}
    holds = {_label(s, use) for use, s in owners if use.how == "hold"}
    rows, cut, cutters = _overlap(base.name, grid, clocks, holds)
    table: Table = dict(streams)
    table[time] = grid[rows]
    done: dict[tuple[str, str], Resampled] = {}
    rates: dict[str, float] = {}
    for use, owner in owners:
        parts, label = [_values(streams, name) for name in use.columns], _label(owner, use)
        names = [shifted(name, use.shift) for name in use.columns]
        if owner is base and not use.shift:
            table |= {name: p[rows] for name, p in zip(names, parts, strict=True)}
        elif label not in clocks:  # a single message, such as a latched one, stands for the whole log
            table |= {name: p[0] for name, p in zip(names, parts, strict=True)}
        elif all(p.dtype.kind in "biuf" for p in parts):
            values, report = _bring(clocks[label], parts, grid[rows], use)
            table |= dict(zip(names, values, strict=True))
            if use.measured and any(not np.isfinite(v).all() for v in values):
                rates.update((name, float(report["rate"])) for name in names)
            told = Resampled(owner.name, owner.clock if kind == "stamps" else "receive time", use.how, **report)
            done[label, use.how] = max(done.get((label, use.how), told), told, key=lambda r: r.missing)
    clock = base.clock if kind == "stamps" else "receive time"
    ahead, moving = {}, {}
    if kind == "stamps":
        ahead = _ahead([(base, 0.0), *others.values()])
        moving = {s.name: wandering(s.stamps, s.received) for s in (base, *(s for s, _ in others.values()))}
    return Alignment(table, base.name, clock, tuple(done.values()), rates, ahead, moving, cut, cutters)


def _require_present(streams: Streams, names: Sequence[str]) -> None:
    for name in names:
        topic = next((t for t in streams.left_out if name == t or name.startswith((f"{t}.", f"{t}["))), None)
        if topic is not None and name not in streams and streams.owner(name) is None:
            raise InputError(f"column {name!r} cannot be used: {topic}: {streams.left_out[topic]}")


def _owner(streams: Streams, use: Use) -> Stream | None:
    """The stream of columns that are used together; None where they are constants or not there at all."""
    owners = {s.name: s for name in use.columns if (s := streams.owner(name)) is not None}
    if len(owners) > 1 and use.how == "slerp":
        raise InputError(
            f"columns {', '.join(use.columns)} come from {' and '.join(owners)}; a quaternion needs one clock"
        )
    return next(iter(owners.values()), None)


def _require_forward(streams: Streams, base: Stream, others: Sequence[Stream]) -> None:
    """Refuse streams whose clock was set back; of the base that is told where its time is read."""
    for stream in others:
        raw = streams.seconds(stream, "stamps")
        found = set_back(raw, GAP * Clock(raw).interval)
        if found is not None:
            at, seconds = found
            raise InputError(
                f"the times of {stream.name} go back by {seconds:.3g} s at its message {at} and stay behind: its clock "
                f"({stream.clock}) was set meanwhile; cut the recording there, or name '{base.name}.received' as the "
                "time column, and all are taken as they were received"
            )


def _ahead(used: Sequence[tuple[Stream, float]]) -> dict[str, float]:
    """Of streams and the shifts that their columns are used with, those whose stamps come after their receipt."""
    found: dict[str, float] = {}
    for stream, shift in used:
        lead = float(np.median(stream.stamps - stream.received)) * 1e-9 - shift
        if lead > 0:
            found[stream.name] = max(lead, found.get(stream.name, 0.0))
    return found


def _own_clock(streams: Streams, use: Use) -> Use:
    """A mask that is not of the stream of the channel that it is of stays where it is."""
    if use.how != "both" or _owner(streams, use) is _owner(streams, Use(use.beside, "linear")):
        return use
    return Use(use.columns, "hold")


def _label(stream: Stream, use: Use) -> str:
    return shifted(stream.name, use.shift)


def _single(streams: Streams, time: str, uses: Sequence[Use]) -> Alignment:
    """A time column of another kind, such as a raw stamp: it serves the columns of its own stream."""
    base = streams.owner(time)
    if any(use.shift for use in uses):
        raise InputError(f"`shift` is taken from a topic's own times, and {time!r} is none; {_clocks(streams)}")
    stray = next((c for u in uses for c in u.columns if (s := streams.owner(c)) is not None and s is not base), None)
    if stray is not None:
        raise InputError(
            f"column {stray!r} has times of its own, and {time!r} is not a time that it can be brought to; "
            f"{_clocks(streams)}"
        )
    name = "" if base is None else base.name
    return Alignment(dict(streams), name, time, (), {}, {}, {}, (0.0, 0.0), ("", ""))


def _clocks(streams: Streams) -> str:
    return f"name one of {', '.join(sorted({f'{s.name}.time' for s in streams.streams})[:8])}"


def _overlap(
    base: str, grid: Array, clocks: dict[str, Clock], holds: set[str]
) -> tuple[slice, tuple[float, float], tuple[str, str]]:
    """Rows that every stream reaches; a held command reaches on to the end."""
    first, opener = max([(c.time[0], n) for n, c in clocks.items()], default=(grid[0], ""))
    last, closer = min([(c.time[-1], n) for n, c in clocks.items() if n not in holds], default=(grid[-1], ""))
    inside = np.flatnonzero((grid >= first) & (grid <= last))
    if len(inside) < 2:
        spans = {base: (grid[0], grid[-1])} | {n: (c.time[0], c.time[-1]) for n, c in clocks.items()}
        told = ", ".join(f"{n} {a:.6g} to {b:.6g} s" for n, (a, b) in spans.items())
        raise InputError(
            f"its streams have no time in common ({told}); if their stamps come from several clocks, name "
            f"'{base}.received' as the time column, and all are taken as they were received"
        )
    rows = slice(int(inside[0]), int(inside[-1]) + 1)
    cut = (float(grid[rows][0] - grid[0]), float(grid[-1] - grid[rows][-1]))
    return rows, cut, (opener, closer)


def _values(streams: Streams, name: str) -> NDArray[Any]:
    if name in streams:
        return streams[name]
    whole, _, index = name.removesuffix("]").rpartition("[")
    values, i = streams[whole], int(index) if index.isdigit() else -1
    if values.ndim != 2 or not 0 <= i < values.shape[1]:
        there = f"entries 0 to {values.shape[1] - 1}" if values.ndim == 2 else "no entries"
        raise InputError(f"column {name!r}: {whole!r} has {there}")
    return values[:, i]


def _bring(
    clock: Clock, parts: Sequence[NDArray[Any]], grid: Array, use: Use
) -> tuple[list[NDArray[Any]], dict[str, Any]]:
    """Columns at the times `grid`, and what is reported of them."""
    widths = np.cumsum([0] + [1 if p.ndim == 1 else p.shape[1] for p in parts])
    columns = np.concatenate([p[clock.order].reshape(len(clock.time), -1) for p in parts], 1).astype(np.float64)
    time, interval = clock.time, clock.interval
    there: NDArray[np.bool_] = np.asarray(np.isfinite(columns).all(1))
    if use.measured and 1 < there.sum() < len(there):  # a message that lacks a value is no sample of it
        time, columns = time[there], columns[there]
        interval = float(np.median(np.diff(time)))
    step = float(np.median(np.diff(grid)))
    gap, late, silent = GAP * interval, 0.0, 0.0
    fresh = np.ones(len(grid), bool)
    if use.how == "hold":
        values, gap, late = held(time, columns, grid), np.inf, lateness(time, grid)
        silent = clock.silence(float(grid[-1]), GAP)
    elif use.how == "both":
        values, gap = flagged(time, columns, grid), np.inf
    else:
        values = interpolated(time, columns, grid, gap, use.how == "slerp", use.turn)
        if use.measured and interval > SLOWER * step:
            fresh = nearest_rows(time, grid)
    missing = float(np.isnan(values[fresh]).any(1).mean()) if fresh.any() else 1.0
    values[~fresh] = np.nan
    out = [values[:, a] if p.ndim == 1 else values[:, a:b] for p, a, b in zip(parts, widths, widths[1:], strict=False)]
    report = {
        "rate": 1 / interval if interval else np.inf,
        "base_rate": 1 / step,
        "gap": gap,
        "missing": missing,
        "kept": float(fresh.mean()),
        "late": late,
        "longest": clock.longest,
        "silent": silent,
        "repeated": clock.repeated,
        "disordered": clock.disordered,
        "shift": use.shift,
    }
    return out, report
