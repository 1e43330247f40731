"""Tables of logged columns from CSV, Parquet, npz and MATLAB files; other formats are added with `register_reader`."""

import csv
import itertools
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import InputError, NfcError
from nfc_gym.measured.mat_tags import require_sound

Table = dict[str, NDArray[Any]]
Reader = Callable[[Path], Table]

_READERS: dict[str, Reader] = {}


def register_reader(suffix: str, reader: Reader) -> None:
    """Have files that end in `suffix` (`".bag"`) read by `reader`: path -> columns (T,), arrays (T, k) or scalars."""
    _READERS[suffix.lower()] = reader


def suffixes() -> tuple[str, ...]:
    """Suffixes that a reader is registered for."""
    return tuple(_READERS)


def read_table(path: Path) -> Table:
    """Columns of a log file by name: (T,), (T, k), or 0-d arrays that stand for the whole log.

    Raises:
      InputError: the file is missing, empty, truncated, of another format, holds no column or one name twice.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(
            f"{path}: no reader for {path.suffix or 'a file without suffix'}; known: {', '.join(_READERS)}"
        )
    if not path.is_file():
        raise InputError(f"{path}: {'is a folder, not a file' if path.is_dir() else 'no such file'}")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty; record or copy it again, or leave it out of `logs`")
    try:
        table = {str(name): _as_seconds(np.asarray(values)) for name, values in reader(path).items()}
    except (NfcError, PermissionError):
        raise
    except Exception as e:  # parsers trip over damaged files in every way there is
        raise _broken(path, e) from None
    if not table:
        raise InputError(f"{path}: the file holds no column")
    return table


def _broken(path: Path, why: object) -> InputError:
    first = str(why).strip().splitlines()[0] if str(why).strip() else type(why).__name__
    kind = path.suffix.lstrip(".")
    return InputError(f"{path}: truncated or not a {kind} file ({first}); copy it again, or leave it out of `logs`")


def _as_seconds(values: NDArray[Any]) -> NDArray[Any]:
    """Dates become seconds since 1970; all else stays as it is."""
    return values.astype("datetime64[ns]").astype(np.int64) * 1e-9 if values.dtype.kind == "M" else values


def _read_csv(path: Path) -> Table:
    import pandas as pd

    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = [line for line in itertools.islice(file, 3) if line.strip()]
            header_line = lines[0] if lines else ""
            separator = max(",;\t", key=header_line.count)
            header = [name.strip() for name in next(csv.reader([header_line], delimiter=separator), [])]
        if len(lines) < 2:
            raise InputError(f"{path}: no rows under the header")
        twice = sorted({name for name in header if header.count(name) > 1})
        if twice:
            raise InputError(
                f"{path}: column {twice[0]!r} appears {header.count(twice[0])} times; rename or remove one"
            )
        with warnings.catch_warnings(action="error", category=pd.errors.ParserWarning):  # rows longer than the header
            frame = pd.read_csv(path, sep=separator, encoding="utf-8-sig", skipinitialspace=True, index_col=False)
    except pd.errors.ParserWarning:
        raise InputError(f"{path}: rows have more fields than the header names; give every column a name") from None
    except (UnicodeDecodeError, csv.Error, pd.errors.ParserError, pd.errors.EmptyDataError) as e:
        raise _broken(path, e) from None
    return {str(name).strip(): frame[name].to_numpy() for name in frame.columns}


def _read_parquet(path: Path) -> Table:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path) as file:  # not read_table: it takes a folder named `a=1` for a column
            table = file.read()
    except (pa.ArrowException, OSError, EOFError) as e:
        if isinstance(e, OSError) and e.errno is not None:
            raise
        raise _broken(path, e) from None
    twice = sorted({name for name in table.column_names if table.column_names.count(name) > 1})
    if twice:
        raise InputError(f"{path}: column {twice[0]!r} appears more than once; rename or remove one")
    return {name: _arrow_column(table.column(name)) for name in table.column_names}


def _arrow_column(column: Any) -> NDArray[Any]:
    values = column.to_numpy()
    if values.dtype == object and len(values) and all(isinstance(v, np.ndarray | list) for v in values):
        lengths = {len(v) for v in values}
        return np.stack([np.asarray(v) for v in values]) if len(lengths) == 1 else values
    return values


def _read_npz(path: Path) -> Table:
    try:
        with np.load(path, allow_pickle=False) as archive:
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise InputError(
                    f"{path}: holds a single array without a name; save with numpy.savez(path, time=..., ...)"
                )
            names = list(archive.files)
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise InputError(f"{path}: column {twice[0]!r} appears more than once")
            return {name: archive[name] for name in names}
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, KeyError, ValueError) as e:
        if "allow_pickle" in str(e):
            why = "holds Python objects, which are not opened; save plain numbers (astype(float))"
            raise InputError(f"{path}: {why}, or the file is no npz at all") from None
        raise _broken(path, e) from None


def _read_mat(path: Path) -> Table:
    import scipy.io

    data = path.read_bytes()
    if data.startswith(b"\x89HDF") or b"MATLAB 7.3" in data[:128]:
        raise InputError(f"{path}: a MATLAB v7.3 file; save it with `save('{path.name}', ..., '-v7')`")
    try:
        require_sound(data)
        with warnings.catch_warnings(action="error", category=scipy.io.matlab.MatReadWarning):  # one name twice
            content = scipy.io.loadmat(path, simplify_cells=True)
    except Exception as e:  # the parser trips over damaged files in every way there is
        raise _broken(path, e) from None
    return dict(_flat({k: v for k, v in content.items() if not k.startswith("__")}, ""))


def _flat(content: dict[str, Any], prefix: str) -> list[tuple[str, NDArray[Any]]]:
    """Structs become `struct.field`."""
    found: list[tuple[str, NDArray[Any]]] = []
    for name, value in content.items():
        found += _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else [(prefix + name, np.asarray(value))]
    return found


for _suffix, _reader in ((".csv", _read_csv), (".parquet", _read_parquet), (".npz", _read_npz), (".mat", _read_mat)):
    register_reader(_suffix, _reader)
