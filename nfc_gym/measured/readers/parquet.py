"""Parquet files."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import InputError
from nfc_gym.measured.readers.registry import Table, broken, wanted


def read_parquet(path: Path, columns: Collection[str] | None = None) -> Table:
    """Columns by name; lists of one length are arrays (T, k), NaN where a row has none. Of columns that none of
    `columns` belongs to only the name is read."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path) as file:  # not read_table: it takes a folder named `a=1` for a column
            names = file.schema_arrow.names
            table = file.read([name for name in names if wanted(name, columns)])
    except (pa.ArrowException, OSError, EOFError) as e:
        if isinstance(e, OSError) and e.errno is not None:
            raise
        raise broken(path, e) from None
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"{path}: column {twice[0]!r} appears more than once; rename or remove one")
    there = set(table.column_names)
    return {name: _arrow_column(table.column(name)) if name in there else np.empty(0) for name in names}


def _arrow_column(column: Any) -> NDArray[Any]:
    values = column.to_numpy()
    if values.dtype != object or not all(v is None or isinstance(v, np.ndarray | list) for v in values):
        return values
    lengths = {len(v) for v in values if v is not None}
    if len(lengths) != 1:
        return values
    none = np.full(lengths.pop(), np.nan)
    return np.stack([none if v is None else np.asarray(v) for v in values])
