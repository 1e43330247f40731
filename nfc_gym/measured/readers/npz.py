"""NumPy archives."""

import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path

import numpy as np

from nfc_gym.core import InputError
from nfc_gym.measured.readers.registry import Table, broken, wanted


def read_npz(path: Path, columns: Collection[str] | None = None) -> Table:
    """Arrays by name; pickled objects are refused. Of arrays that none of `columns` belongs to only the name is read:
    there may be pictures among them."""
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
            return {name: archive[name] if wanted(name, columns) else np.empty(0) for name in names}
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, KeyError, ValueError) as e:
        if "allow_pickle" in str(e):
            why = "holds Python objects, which are not opened; save plain numbers (astype(float))"
            raise InputError(f"{path}: {why}, or the file is no npz at all") from None
        raise broken(path, e) from None
