"""A mapping file and the logs it names, converted: SI units, quaternions scalar first, time from 0, splits assigned."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import Channel, InputError, Log
from nfc_gym.measured import units
from nfc_gym.measured.align import Alignment, align, uses
from nfc_gym.measured.channels import parse_channel
from nfc_gym.measured.columns import LogColumns
from nfc_gym.measured.entries import Measured, Servo
from nfc_gym.measured.mapping import Mapping, Split, load_mapping
from nfc_gym.measured.readers import Streams, read_table
from nfc_gym.measured.splits import Fold, Source, divide, find_logs
from nfc_gym.physics.effects.base import TIME

Array = NDArray[np.float64]
T = TypeVar("T")

LARGEST_GAP = 10.0  # sampling intervals; a longer pause makes two logs of one
LARGEST = 1e20  # in any unit; nanoseconds since 1970 are 1.8e18
UNIT_NORM = 0.05  # a quaternion's norm may differ so much from 1 (rounding, interpolation) and is then normalised
ROUNDING = 1e-14  # a norm that differs so little from 1 is 1


@dataclass(frozen=True)
class Dataset:
    """What a mapping file describes, read and converted.

    Attributes:
      mapping: the file's content.
      path: the mapping file.
      logs: in the order of the mapping; logs cut by time are parts named `<log>@fit`, `<log>@select`, `<log>@verify`.
      folds: one, or with `by: rotate` one for each group that verifies.
      independent_splits: False where two splits share a log.
      files: the log files that were read.
    """

    mapping: Mapping
    path: Path
    logs: tuple[Log, ...]
    folds: tuple[Fold, ...]
    independent_splits: bool
    files: tuple[Path, ...]

    @property
    def folder(self) -> Path:
        """The mapping's folder, from which its paths count."""
        return self.path.parent

    @property
    def splits(self) -> dict[str, Split]:
        """Log name -> fit, select or verify, in the first fold."""
        return dict(self.folds[0].splits)

    def fold(self, name: str) -> Fold:
        """The fold of that name; an unknown one raises `InputError` listing the folds."""
        for fold in self.folds:
            if fold.name == name:
                return fold
        raise InputError(f"no fold {name!r}; there are: {', '.join(repr(f.name) for f in self.folds)}")

    def of(self, split: Split, fold: Fold | None = None) -> tuple[Log, ...]:
        """The logs of a split, in the given fold or the first."""
        names = set((fold or self.folds[0]).names(split))
        return tuple(log for log in self.logs if log.name in names)


@dataclass(frozen=True)
class Defect:
    """Something in a log file that stops it from being used: where in the mapping, and what it is and what to do."""

    where: str
    text: str


class Reading(NamedTuple):
    """What became of one log file.

    Attributes:
      log: None where `defects` stop it from being used.
      defects: everything that does.
      alignment: how its streams were brought to one time; None where the file has one time for all columns.
    """

    log: Log | None
    defects: list[Defect]
    alignment: Alignment | None = None


def load(path: Path | str) -> Dataset:
    """Read a mapping file and all its logs.

    Raises:
      InputError: the mapping or a log cannot be used; all that is wrong with the first such log, one a line.
    """
    path = Path(path)
    mapping = load_mapping(path)
    sources = find_logs(mapping, path.parent)
    logs = []
    for source in sources:
        log, defects, _ = read_log(mapping, source)
        if log is None:
            raise InputError("\n".join(f"{source.path}: {p.where}: {p.text}" for p in defects))
        logs.append(log)
    return assemble(mapping, path, sources, logs)


def assemble(mapping: Mapping, path: Path, sources: list[Source], logs: list[Log]) -> Dataset:
    """Divide logs that were read into splits; raises `InputError` where the rule cannot be followed."""
    division = divide(mapping.split, sources, logs)
    files = tuple(dict.fromkeys(file for s in sources for file in _files(s.path)))
    return Dataset(mapping, path, division.logs, division.folds, division.independent, files)


def _files(log: Path) -> list[Path]:
    """A log's file, or those of its folder."""
    return sorted(f for f in log.rglob("*") if f.is_file()) if log.is_dir() else [log]


def read_log(mapping: Mapping, source: Source) -> Reading:
    """One log file as the mapping describes it, or everything that is wrong with it."""
    defects: list[Defect] = []

    def attempt(where: str, work: Callable[[], T]) -> T | None:
        try:
            return work()
        except InputError as e:
            defects.append(Defect(where, str(e)))
            return None

    time_column, used = mapping.time.columns[0], uses(mapping)
    try:
        table = read_table(source.path, source.part, {time_column, *(name for use in used for name in use.columns)})
    except InputError as e:
        return Reading(None, [Defect("file", str(e).removeprefix(f"{source.path}: "))])
    alignment = None
    if isinstance(table, Streams):
        streams = table
        alignment = attempt("streams", lambda: align(streams, time_column, used))
        if alignment is None:
            return Reading(None, defects)
    columns = LogColumns(table if alignment is None else alignment.table)
    time = attempt("time", lambda: _time(mapping, columns))
    if time is None:
        return Reading(None, defects, alignment)
    m = mapping
    controls = {
        k: attempt(f"controls.{k}", lambda c=c: _signal(columns, c.columns, c.unit)) for k, c in m.controls.items()
    }
    exogenous = {
        k: attempt(f"exogenous.{k}", lambda c=c: _signal(columns, c.columns, c.unit)) for k, c in m.exogenous.items()
    }
    channels = {
        k: attempt(f"channels.{k}", lambda k=k, c=c: _channel(k, c, columns, alignment)) for k, c in m.channels.items()
    }
    exogenous.setdefault(TIME, time)  # that of the whole file, where a split by time cuts it
    known = {
        f"{k.field}:{'+'.join(k.of)}": attempt(
            f"known.{k.field}",
            lambda k=k: units.to_si(_finite(columns.product(k.columns, k.scale) + k.offset, "its columns"), k.unit),
        )
        for k in m.known
    }
    servo = {
        k: attempt(f"controls.{k}.servo", lambda s=c.servo: _servo(columns, s))
        for k, c in m.controls.items()
        if c.servo
    }
    if defects:
        return Reading(None, defects, alignment)
    parts = {"controls": controls, "channels": channels, "exogenous": exogenous, "known": known, "servo": servo}
    log = attempt(
        "log", lambda: Log(name=source.name, time=time, group=source.group, condition=source.condition, **parts)
    )
    return Reading(log, defects, alignment)


def _time(mapping: Mapping, columns: LogColumns) -> Array:
    name = mapping.time.columns[0]
    raw = columns.time(name)
    bad = np.flatnonzero(~np.isfinite(raw))
    if bad.size:
        raise InputError(f"column {name!r} is not a number at row {bad[0]}; remove such rows")
    _plausible(raw, f"column {name!r}")
    time = units.to_si(raw - raw[0], mapping.time.unit)
    step = np.diff(time)
    back = np.flatnonzero(step <= 0)
    if len(back) == len(step):
        raise InputError(f"column {name!r} never increases; name the column that holds the time")
    if back.size:
        k = int(back[0])
        how = "stands still" if step[k] == 0 else "goes back"
        raise InputError(
            f"column {name!r} {how} at row {k + 1} ({time[k]:.6g} to {time[k + 1]:.6g} s; {back.size} such rows); "
            "remove repeated rows, or cut the file there into two logs"
        )
    longest = int(step.argmax())
    if step[longest] > LARGEST_GAP * np.median(step):
        count = int((step > LARGEST_GAP * np.median(step)).sum())
        raise InputError(
            f"a gap of {step[longest]:.3g} s after row {longest}, at {time[longest]:.6g} s, where samples are "
            f"{np.median(step):.3g} s apart ({count} such gap{'s' * (count > 1)}); cut the file there into logs"
        )
    return time


def _finite(values: Array, what: str, needed: NDArray[np.bool_] | None = None) -> Array:
    bad: NDArray[np.bool_] = np.asarray(~np.isfinite(values.reshape(len(values), -1)).all(1))
    if needed is not None:
        bad &= needed
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise InputError(
            f"{what}: {int(bad.sum())} of {len(bad)} rows are NaN or infinite, the first row {row}; cut the log there, "
            "or, for a measured channel, name a `mask` column that is false in those rows"
        )
    return _plausible(values, what)


def _plausible(values: Array, what: str) -> Array:
    wild = np.argwhere(np.abs(np.where(np.isfinite(values), values, 0.0)) > LARGEST)
    if len(wild):
        row = wild[0]
        raise InputError(
            f"{what}: {values[tuple(row)]:.3g} at row {row[0]} ({len(wild)} such values), which nothing measures; "
            "correct the column or its unit, or leave out those rows"
        )
    return values


def _signal(columns: LogColumns, names: tuple[str, ...], unit: str) -> Array:
    return units.to_si(_finite(columns.one(names[0]), f"column {names[0]!r}"), unit)


def _servo(columns: LogColumns, servo: Servo) -> dict[str, Array]:
    terms = {"gain": servo.gain, "supply": servo.supply, "damping": servo.damping}
    return {name: _finite(columns.product(term.columns, term.scale), name) for name, term in terms.items()}


def _channel(name: str, entry: Measured, columns: LogColumns, alignment: Alignment | None) -> Channel:
    parsed = parse_channel(name)
    raw = columns.many(entry.columns)
    width = len(entry.axes) if entry.axes else parsed.width or (1 if parsed.kind in ("joint", "force") else None)
    if width is not None and raw.shape[1] != width:
        raise InputError(
            f"{raw.shape[1]} columns where {width} {'are' if width > 1 else 'is'} wanted; name them in `columns`"
        )
    mask = columns.mask(entry.mask) if entry.mask else None
    present: NDArray[np.bool_] = np.asarray(np.isfinite(raw).all(1))
    rates = {} if alignment is None else alignment.rates
    rate = entry.rate or next((rates[name] for name in entry.columns if name in rates), None)
    if rate is not None and not present.all():  # between a slow sensor's samples and in gaps nothing was measured
        mask = present if mask is None else np.logical_and(mask, present)
    _finite(raw, f"columns {', '.join(entry.columns)}", mask)
    if not present.any():
        raise InputError(f"columns {', '.join(entry.columns)}: every row is NaN or infinite; name other columns")
    unit = entry.unit or "1"
    values = units.to_si(_held(raw, present), unit)
    if parsed.quantity == "quat":
        values = _quaternion(values, entry.order == "xyzw")
    return Channel(
        values=values[:, 0] if values.shape[1] == 1 else values,
        unit=units.si_unit(unit),
        noise=None if entry.noise is None else units.spread_to_si(entry.noise, unit),
        smooth=entry.smooth,
        mask=mask,
        axes=entry.axis_indices,
        rate=rate,
    )


def _held(values: Array, present: NDArray[np.bool_]) -> Array:
    """Rows that are not compared take the last present row (or the first), so that arithmetic goes through."""
    if present.all():
        return values
    last = np.maximum.accumulate(np.where(present, np.arange(len(values)), -1))
    return values[np.where(last < 0, int(np.flatnonzero(present)[0]), last)]


def _quaternion(values: Array, scalar_last: bool) -> Array:
    """Scalar first, of norm 1, and with the sign that is nearest to the row before."""
    norm = np.linalg.norm(values, axis=1)
    off = np.flatnonzero(np.abs(norm - 1) > UNIT_NORM)
    if off.size:
        raise InputError(
            f"norm {norm[off[0]]:.3g} at row {off[0]} ({off.size} such rows) where unit quaternions are wanted; "
            "name their four columns"
        )
    norm = np.where(np.abs(norm - 1) < ROUNDING, 1.0, norm)  # what is of unit length keeps its bits
    quat = (np.roll(values, 1, axis=1) if scalar_last else values) / norm[:, None]
    flips = np.where((quat[1:] * quat[:-1]).sum(1) < 0, -1.0, 1.0)
    return quat * np.cumprod(np.concatenate([[1.0], flips]))[:, None]
