"""CSV files of UTF-8 text: separator, quotes and byte-order mark are found out."""

import csv
import itertools
import os
import re
import warnings
from collections.abc import Collection
from pathlib import Path

import numpy as np

from nfc_gym.core import InputError
from nfc_gym.measured.readers.registry import Table, broken, wanted

_QUOTED = re.compile(r'"[^"]*"')
_LONGEST = 1 << 16  # bytes of a row
_ROWS = 1 << 14  # rows that are read at once, of which the wanted columns are kept


def read_csv(path: Path, columns: Collection[str] | None = None) -> Table:
    """Columns by their header; separated by commas, semicolons or tabs. Of those that none of `columns` belongs to only
    the name is kept."""
    import pandas as pd

    header_line = ""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = [line for line in itertools.islice(file, 3) if line.strip()]
            header_line = lines[0] if lines else ""
            separator = max(",;\t", key=_QUOTED.sub("", header_line).count)  # a quoted name may hold some
            header = [name.strip() for name in next(csv.reader([header_line], delimiter=separator), [])]
        if len(lines) < 2:
            raise InputError(f"{path}: no rows under the header")
        twice = sorted({name for name in header if header.count(name) > 1})
        if twice:
            raise InputError(
                f"{path}: column {twice[0]!r} appears {header.count(twice[0])} times; rename or remove one"
            )
        # Rows longer than the header are warned of, or refused; not with `usecols`, with which they pass.
        with (
            warnings.catch_warnings(action="error", category=pd.errors.ParserWarning),
            pd.read_csv(
                path, sep=separator, encoding="utf-8-sig", skipinitialspace=True, index_col=False, chunksize=_ROWS
            ) as frames,
        ):
            parts = [{str(n).strip(): f[n].to_numpy() for n in f if wanted(str(n).strip(), columns)} for f in frames]
        _require_whole(path, separator, len(next(csv.reader(lines[1:], delimiter=separator))))
    except (pd.errors.ParserWarning, pd.errors.ParserError) as e:
        if header_line.lstrip().startswith(("#", "//", "%")):
            raise InputError(f"{path}: begins with a comment; the first line must be the columns' names") from None
        if isinstance(e, pd.errors.ParserError):
            raise broken(path, e) from None
        raise InputError(f"{path}: rows have more fields than the header names; give every column a name") from None
    except UnicodeDecodeError as e:
        raise InputError(
            f"{path}: is no UTF-8 text (byte {e.object[e.start]:#x}); save it with that encoding"
        ) from None
    except (csv.Error, pd.errors.EmptyDataError) as e:
        raise broken(path, e) from None
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} | {
        name: np.empty(0) for name in header if name and name not in parts[0]
    }


def _require_whole(path: Path, separator: str, width: int) -> None:
    """Refuse a file whose last row has no end and lacks fields: the last number in it may be a part of one."""
    with path.open("rb") as file:
        file.seek(max(file.seek(0, os.SEEK_END) - _LONGEST, 0))
        last = file.read().rpartition(b"\n")[2].rpartition(b"\r")[2].decode("utf-8", "replace")
    if last.strip() and len(last) < _LONGEST and len(next(csv.reader([last], delimiter=separator))) < width:
        raise InputError(
            f"{path}: its last row is cut off, {last[:40]!r} where {width} fields are wanted; remove that row"
        )
