"""CSV files: separator, quotes and byte-order mark are found out."""

import csv
import itertools
import warnings
from pathlib import Path

from nfc_gym.core import InputError
from nfc_gym.measured.readers.registry import Table, broken


def read_csv(path: Path) -> Table:
    """Columns by their header; separated by commas, semicolons or tabs."""
    import pandas as pd

    header_line = ""
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
    except (pd.errors.ParserWarning, pd.errors.ParserError) as e:
        if header_line.lstrip().startswith(("#", "//", "%")):
            raise InputError(f"{path}: begins with a comment; the first line must be the columns' names") from None
        if isinstance(e, pd.errors.ParserError):
            raise broken(path, e) from None
        raise InputError(f"{path}: rows have more fields than the header names; give every column a name") from None
    except (UnicodeDecodeError, csv.Error, pd.errors.EmptyDataError) as e:
        raise broken(path, e) from None
    return {str(name).strip(): frame[name].to_numpy() for name in frame.columns}
