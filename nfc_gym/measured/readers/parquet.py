"""Parquet files."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import InputError
from nfc_gym.measured.readers.registry import Table, broken


def read_parquet(path: Path) -> Table:
    """Columns by name; lists of one length are arrays (T, k)."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path) as file:  # not read_table: it takes a folder named `a=1` for a column
            table = file.read()
    except (pa.ArrowException, OSError, EOFError) as e:
        if isinstance(e, OSError) and e.errno is not None:
            raise
        raise broken(path, e) from None
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
