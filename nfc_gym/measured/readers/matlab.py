"""MATLAB files up to version 7."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import InputError
from nfc_gym.measured.mat_tags import require_sound
from nfc_gym.measured.readers.registry import Table, broken


def read_mat(path: Path) -> Table:
    """Variables by name; fields of structs as `struct.field`, of arrays of structs as `struct[0].field`."""
    import scipy.io

    data = path.read_bytes()
    if b"\x89HDF" in (data[:4], data[512:516]) or b"MATLAB 7.3" in data[:128]:
        raise InputError(f"{path}: a MATLAB v7.3 file; save it with `save('{path.name}', ..., '-v7')`")
    try:
        require_sound(data)
        with warnings.catch_warnings(action="error", category=scipy.io.matlab.MatReadWarning):  # one name twice
            content = scipy.io.loadmat(path, simplify_cells=True)
    except Exception as e:  # the parser trips over damaged files in every way there is
        raise broken(path, e) from None
    return dict(_flat({k: v for k, v in content.items() if not k.startswith("__")}, ""))


def _flat(content: dict[str, Any], prefix: str) -> list[tuple[str, NDArray[Any]]]:
    """Structs become `struct.field`, arrays of them, such as Simulink's `signals`, `struct[0].field`."""
    found: list[tuple[str, NDArray[Any]]] = []
    for name, value in content.items():
        if isinstance(value, dict):
            found += _flat(value, f"{prefix}{name}.")
        elif isinstance(value, list) and value and all(isinstance(v, dict) for v in value):
            for i, one in enumerate(value):
                found += _flat(one, f"{prefix}{name}[{i}].")
        else:
            found.append((prefix + name, np.asarray(value)))
    return found
