"""Which reader opens which file: by suffix, or by what a folder holds; one file may hold several logs."""

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import InputError, NfcError
from nfc_gym.measured.readers.streams import Streams, normal_name

Table = dict[str, NDArray[Any]]
Reader = Callable[[Path], Table]
Parts = Callable[[Path], tuple[str, ...]]
PartReader = Callable[[Path, str], Table]
SelectiveReader = Callable[[Path, Collection[str] | None], Table]


@dataclass(frozen=True)
class _Entry:
    """`read` takes a path; where `parts` is, also the name of a part; where `selective`, also the columns wanted."""

    read: Callable[..., Table]
    parts: Parts | None = None
    selective: bool = False


_SUFFIXES: dict[str, _Entry] = {}
_FOLDERS: dict[str, _Entry] = {}


def register_reader(suffix: str, reader: Reader | SelectiveReader, selective: bool = False) -> None:
    """Have files that end in `suffix` (`".bag"`) read by `reader`: path -> columns (T,), arrays (T, k) or scalars.

    A `selective` reader also takes the names of the columns that are wanted, or None for all; of the others it may give
    a sample only or an empty array, so that they can be suggested for a name that is misspelt.
    """
    _SUFFIXES[suffix.lower()] = _Entry(reader, selective=selective)


def register_parts(suffix: str, parts: Parts, reader: PartReader) -> None:
    """The same for files of several logs: `parts(path)` names them, `reader(path, part)` reads one."""
    _SUFFIXES[suffix.lower()] = _Entry(reader, parts)


def register_folder(
    marker: str, reader: Reader | PartReader | SelectiveReader, parts: Parts | None = None, selective: bool = False
) -> None:
    """Have a folder that holds a file `marker` (`"metadata.yaml"`) read as one log, or as several where `parts` is."""
    _FOLDERS[marker] = _Entry(reader, parts, selective)


def suffixes() -> tuple[str, ...]:
    """Suffixes that a reader is registered for."""
    return tuple(_SUFFIXES)


def is_log(path: Path) -> bool:
    """Whether `path` is a file, or a folder that is read as a log."""
    return path.is_file() or _folder(path) is not None


def log_parts(path: Path) -> tuple[str, ...]:
    """Names of the logs in a file that holds several; one empty name for a file that is a log itself.

    Raises:
      InputError: the file cannot be opened.
    """
    entry = _entry(path)
    if entry is None or entry.parts is None:
        return ("",)
    _require(path)
    with parsing(path):
        return entry.parts(path)


def read_table(path: Path, part: str = "", names: Collection[str] | None = None) -> Table:
    """Columns of a log by name: (T,), (T, k), or 0-d arrays that stand for the whole log.

    A file whose columns are sampled at times of their own gives `Streams`, a table that says which are whose.

    Args:
      part: one of `log_parts(path)`.
      names: the columns that are wanted; others may be incomplete. None is all.

    Raises:
      InputError: the file is missing, empty, truncated, of another format, holds no column or one name twice.
    """
    entry = _entry(path)
    if entry is None and path.is_dir():
        raise InputError(f"{path}: is a folder, not a file{_why_no_log(path)}")
    if entry is None:
        raise InputError(
            f"{path}: no reader for {path.suffix or 'a file without suffix'}; known: {', '.join(_SUFFIXES)}"
            f"{_packed(path)}"
        )
    _require(path)
    arguments = ((part,) if entry.parts else ()) + ((names,) if entry.selective else ())
    with parsing(path):
        table = entry.read(path, *arguments)
        if not isinstance(table, Streams):
            table = {normal_name(str(name)): _as_seconds(np.asarray(values)) for name, values in table.items()}
    if not table:
        raise InputError(f"{path}: the file holds no column")
    return table


def wanted(column: str, names: Collection[str] | None) -> bool:
    """Whether one of `names` is that column or an entry of it, `column[i]`; None is every column."""
    column = normal_name(column)
    return names is None or any(name == column or name.startswith(f"{column}[") for name in names)


def _entry(path: Path) -> _Entry | None:
    return _folder(path) or (None if path.is_dir() else _SUFFIXES.get(path.suffix.lower()))


def _folder(path: Path) -> _Entry | None:
    return next((entry for marker, entry in _FOLDERS.items() if (path / marker).is_file()), None)


def _require(path: Path) -> None:
    if not path.exists():
        raise InputError(f"{path}: no such file")
    if path.is_file() and path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty; record or copy it again, or leave it out of `logs`")


def _why_no_log(path: Path) -> str:
    """What a folder lacks that looks as if it should be a log."""
    inside = {p.suffix for p in path.iterdir()}
    if inside & {".db3", ".mcap"}:
        return "; a rosbag2 folder without metadata.yaml: write it with `ros2 bag reindex`, or name the file inside"
    return f"; a folder is a log where it holds {' or '.join(_FOLDERS)}"


def _packed(path: Path) -> str:
    """What to do with a compressed file of a recording."""
    inside = path.suffix == ".zstd" and Path(path.stem).suffix in _SUFFIXES
    return "; of a recording that was compressed name the folder, with its metadata.yaml" if inside else ""


def _as_seconds(values: NDArray[Any]) -> NDArray[Any]:
    """Dates become seconds since 1970, durations seconds; all else stays as it is."""
    if values.dtype.kind not in "Mm":
        return values
    fine = "datetime64[ns]" if values.dtype.kind == "M" else "timedelta64[ns]"
    return np.where(np.isnat(values), np.nan, values.astype(fine).astype(np.int64) * 1e-9)


def broken(path: Path, why: object, advice: str = "copy it again, or leave it out of `logs`") -> InputError:
    """The error for a file that its parser gave up on."""
    first = str(why).strip().splitlines()[0] if str(why).strip() else type(why).__name__
    kind = path.suffix.lstrip(".") or "log"
    return InputError(f"{path}: truncated or not a {kind} file ({first}); {advice}")


def needed(path: Path, module: str, extra: str) -> Any:
    """An optional dependency's module; where it is absent, `InputError` names the extra that brings it."""
    try:
        return import_module(module)
    except ImportError as e:
        why = "" if isinstance(e, ModuleNotFoundError) else f" ({e})"
        raise InputError(
            f"{path}: needs {module.partition('.')[0]}, which is not installed{why}; pip install 'nfc_gym[{extra}]'"
        ) from None


@contextmanager
def parsing(path: Path, advice: str = "copy it again, or leave it out of `logs`") -> Iterator[None]:
    """Around a foreign parser: it trips over damaged files in every way there is, and each becomes one `InputError`."""
    try:
        yield
    except NfcError:
        raise
    except OSError as e:
        if e.errno is not None and e.filename is not None:  # the operating system's refusal, not the file's content
            raise
        raise broken(path, e, advice) from None
    except (Exception, MemoryError) as e:
        raise broken(path, e, advice) from None
