"""MATLAB files up to version 7."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import InputError
from nfc_gym.measured.readers.registry import Table, broken


def read_mat(path: Path) -> Table:
    """Variables by name; fields of structs as `struct.field`."""
    import scipy.io

    with path.open("rb") as file:
        start = file.read(128)
    if start.startswith(b"\x89HDF") or b"MATLAB 7.3" in start:
        raise InputError(f"{path}: a MATLAB v7.3 file; save it with `save('{path.name}', ..., '-v7')`")
    try:
        content = scipy.io.loadmat(path, simplify_cells=True)
    except Exception as e:  # the parser trips over damaged files in every way there is
        raise broken(path, e) from None
    return dict(_flat({k: v for k, v in content.items() if not k.startswith("__")}, ""))


def _flat(content: dict[str, Any], prefix: str) -> list[tuple[str, NDArray[Any]]]:
    """Structs become `struct.field`."""
    found: list[tuple[str, NDArray[Any]]] = []
    for name, value in content.items():
        found += _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else [(prefix + name, np.asarray(value))]
    return found
