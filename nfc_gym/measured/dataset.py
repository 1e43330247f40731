"""A mapping file and the logs it names, converted: SI units, quaternions scalar first, time from 0, splits assigned."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import Channel, InputError, Log, units
from nfc_gym.measured.align import Alignment, Use, align, shifted, uses
from nfc_gym.measured.channels import parse_channel
from nfc_gym.measured.columns import LogColumns, finite
from nfc_gym.measured.entries import Measured, Servo
from nfc_gym.measured.even import Evened, evened
from nfc_gym.measured.log_time import require_no_streams, time_of
from nfc_gym.measured.mapping import Mapping, Split, load_mapping
from nfc_gym.measured.readers import Streams, Table, read_table
from nfc_gym.measured.shifting import shift_table, too_long
from nfc_gym.measured.splits import Fold, Source, divide, find_logs
from nfc_gym.measured.stretches import stretches
from nfc_gym.physics.effects.base import TIME

Array = NDArray[np.float64]
T = TypeVar("T")

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
      whole: names of the logs before any was cut by time.
    """

    mapping: Mapping
    path: Path
    logs: tuple[Log, ...]
    folds: tuple[Fold, ...]
    independent_splits: bool
    files: tuple[Path, ...]
    whole: tuple[str, ...]

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
        if len(self.folds) == 1:
            raise InputError(f"no fold {name!r}: folds come with `split: {{by: rotate}}` in the mapping")
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
      logs: it, or the stretches between its gaps, with what the mapping says of each; none where `defects` stop it from
        being used.
      defects: everything that does.
      alignment: how its streams were brought to one time; None where the file has one time for all columns.
      evened: the even rows that were taken for its time stamps; None where these are taken as they are.
    """

    logs: list[tuple[Source, Log]]
    defects: list[Defect]
    alignment: Alignment | None = None
    evened: Evened | None = None


def load(path: Path | str) -> Dataset:
    """Read a mapping file and all its logs.

    Raises:
      InputError: the mapping or a log cannot be used; all that is wrong with the first such log, one a line.
    """
    path = Path(path)
    mapping = load_mapping(path)
    read = []
    for source in find_logs(mapping, path.parent):
        logs, defects, *_ = read_log(mapping, source)
        if defects:
            raise InputError("\n".join(f"{source.path}: {p.where}: {p.text}" for p in defects))
        read += logs
    return assemble(mapping, path, read)


def assemble(mapping: Mapping, path: Path, read: Sequence[tuple[Source, Log]]) -> Dataset:
    """Divide logs that were read into splits; raises `InputError` where the rule cannot be followed."""
    sources, logs = [s for s, _ in read], [log for _, log in read]
    division = divide(mapping.split, sources, logs)
    files = tuple(dict.fromkeys(file for s in sources for file in _files(s.path)))
    whole = tuple(s.name for s in sources)
    return Dataset(mapping, path, division.logs, division.folds, division.independent, files, whole)


def _files(log: Path) -> list[Path]:
    """A log's file, or those of its folder."""
    return sorted(f for f in log.rglob("*") if f.is_file()) if log.is_dir() else [log]


class _Defects(list[Defect]):
    """Collects what goes wrong, so that all of it is told at once."""

    def attempt(self, where: str, work: Callable[[], T]) -> T | None:
        """What `work` returns, or None where it raises `InputError`."""
        try:
            return work()
        except InputError as e:
            self.append(Defect(where, str(e)))
            return None


def read_log(mapping: Mapping, source: Source) -> Reading:
    """One log file as the mapping describes it, or everything that is wrong with it."""
    defects, used = _Defects(), uses(mapping)
    wanted = {*mapping.time.columns, *(name for use in used for name in use.columns)}
    try:
        table = read_table(source.path, source.part, wanted)
    except InputError as e:
        return Reading([], [Defect("file", str(e).removeprefix(f"{source.path}: "))])
    alignment = None
    if isinstance(table, Streams):
        streams = table
        alignment = defects.attempt("streams", lambda: _aligned(streams, mapping, used, defects))
        if alignment is None or defects:
            return Reading([], defects)
        table = alignment.table
    columns = LogColumns(table)
    names = [name for use in used for name in use.columns]
    time = defects.attempt("time", lambda: time_of(mapping.time, columns, names))
    if time is None:
        if columns.rows or _counted(columns, names):
            _parts(mapping, columns, alignment, defects)  # what is wrong with the other columns is told with it
        return Reading([], defects, alignment)
    even = None
    if alignment is None:
        even = _evened(mapping, columns, time)
        time = time if even is None else even.time
        moved = _shifted(mapping, table, time, used, defects)
        if moved is None:
            return Reading([], defects)
        columns, time = moved
    parts = _parts(mapping, columns, alignment, defects)
    parts["exogenous"].setdefault(TIME, time)  # that of the whole file, where a split by time cuts it
    if defects:
        return Reading([], defects, alignment)
    name, group, condition = source.name, source.group, source.condition
    log = defects.attempt("log", lambda: Log(name=name, time=time, group=group, condition=condition, **parts))
    logs = None if log is None else defects.attempt("time", lambda: list(stretches(mapping, source, log)))
    return Reading(logs or [], defects, alignment, even)


def _evened(mapping: Mapping, columns: LogColumns, time: Array) -> Evened | None:
    """Even rows in place of scattering stamps, told by the channels that are renewed at every row."""
    if mapping.time.interval is not None:
        return None
    measured = []
    for entry in mapping.channels.values():
        with suppress(InputError):  # what is wrong with a column is told where it is used
            if entry.rate is None:
                measured.append(columns.many(entry.columns))
    return evened(time, measured)


def _counted(columns: LogColumns, names: list[str]) -> bool:
    """Whether columns agree on the rows of a log whose time cannot be read; they can then be looked at."""
    try:
        return columns.untimed(names) > 0
    except InputError:
        return False


def _aligned(streams: Streams, mapping: Mapping, used: list[Use], defects: _Defects) -> Alignment | None:
    """A log of several clocks at the times of one of them."""
    require_no_streams(streams, mapping.time)
    column = mapping.time.columns[0]
    base = streams.clock(column)
    if base is not None and len(base[0].stamps):
        defects += _too_long(mapping, float(np.ptp(streams.seconds(*base))))
    return None if defects else align(streams, column, used)


def _too_long(mapping: Mapping, duration: float) -> list[Defect]:
    shifts = {name: c.shift for name, c in mapping.channels.items() if c.shift}
    return [Defect(f"channels.{name}.shift", text) for name, text in too_long(shifts, duration)]


def _shifted(
    mapping: Mapping, table: Table, time: Array, used: list[Use], defects: _Defects
) -> tuple[LogColumns, Array] | None:
    """Columns and times of a log of one clock, its shifts taken out."""
    defects += _too_long(mapping, float(time[-1]))
    moved = None if defects else defects.attempt("channels", lambda: shift_table(table, time, used))
    return None if moved is None else (LogColumns(moved[0], len(moved[1])), moved[1])


def _parts(mapping: Mapping, columns: LogColumns, alignment: Alignment | None, defects: _Defects) -> dict[str, Any]:
    """What a `Log` is made of, by name of its attributes; None for what could not be read."""
    m, attempt = mapping, defects.attempt
    return {
        "controls": {
            k: attempt(f"controls.{k}", lambda c=c: _signal(columns, c.columns, c.unit)) for k, c in m.controls.items()
        },
        "exogenous": {
            k: attempt(f"exogenous.{k}", lambda c=c: _signal(columns, c.columns, c.unit))
            for k, c in m.exogenous.items()
        },
        "channels": {
            k: attempt(f"channels.{k}", lambda k=k, c=c: _channel(k, c, columns, alignment))
            for k, c in m.channels.items()
        },
        "known": {
            f"{k.field}:{'+'.join(k.of)}": attempt(
                f"known.{k.field}",
                lambda k=k: units.to_si(finite(columns.product(k.columns, k.scale) + k.offset, "its columns"), k.unit),
            )
            for k in m.known
        },
        "servo": {
            k: attempt(f"controls.{k}.servo", lambda s=c.servo: _servo(columns, s))
            for k, c in m.controls.items()
            if c.servo
        },
    }


def _signal(columns: LogColumns, names: tuple[str, ...], unit: str) -> Array:
    return units.to_si(finite(columns.one(names[0]), f"column {names[0]!r}"), unit)


def _servo(columns: LogColumns, servo: Servo) -> dict[str, Array]:
    terms = {"gain": servo.gain, "supply": servo.supply, "damping": servo.damping}
    return {name: finite(columns.product(term.columns, term.scale), name) for name, term in terms.items()}


def _channel(name: str, entry: Measured, columns: LogColumns, alignment: Alignment | None) -> Channel:
    parsed = parse_channel(name)
    names = tuple(_after_shift(columns, name, entry.shift) for name in entry.columns)
    raw = columns.many(names)
    width = len(entry.axes) if entry.axes else parsed.width or (1 if parsed.kind in ("joint", "force") else None)
    width = width if entry.order is None else 4
    if width is not None and raw.shape[1] != width:
        raise InputError(
            f"{raw.shape[1]} columns where {width} {'are' if width > 1 else 'is'} wanted; name them in `columns`"
        )
    mask = columns.mask(_after_shift(columns, entry.mask, entry.shift)) if entry.mask else None
    present: NDArray[np.bool_] = np.asarray(np.isfinite(raw).all(1))
    rates = {} if alignment is None else alignment.rates
    rate = entry.rate or next((rates[name] for name in names if name in rates), None)
    if rate is not None and not present.all():  # between a slow sensor's samples and in gaps nothing was measured
        mask = present if mask is None else np.logical_and(mask, present)
    finite(raw, f"columns {', '.join(entry.columns)}", mask)
    if not present.any():
        raise InputError(f"columns {', '.join(entry.columns)}: every row is NaN or infinite; name other columns")
    unit = entry.unit or "1"
    values = units.to_si(_held(raw, present), unit)
    if entry.order is not None:
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


def _after_shift(columns: LogColumns, name: str, shift: float) -> str:
    """A column's name with its shift taken out; its own where it has none, is a constant or is not there."""
    return shifted(name, shift) if shifted(name, shift) in columns else name


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
            f"norm {norm[off[0]]:.3g} at row {off[0]} ({off.size} such row{'s' * (off.size > 1)}) "
            "where unit quaternions are wanted; name their four columns"
        )
    norm = np.where(np.abs(norm - 1) < ROUNDING, 1.0, norm)  # what is of unit length keeps its bits
    quat = (np.roll(values, 1, axis=1) if scalar_last else values) / norm[:, None]
    flips = np.where((quat[1:] * quat[:-1]).sum(1) < 0, -1.0, 1.0)
    return quat * np.cumprod(np.concatenate([[1.0], flips]))[:, None]
