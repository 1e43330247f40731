"""Shards of a set of windows: packed into bytes, written whole or not at all, mapped into memory."""

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.differences import differences
from nfc_gym.core.errors import InputError, MissingExtra
from nfc_gym.core.files import replacing, write_whole
from nfc_gym.inference.manifest import MANIFEST, Manifest

try:
    import safetensors
    import safetensors.numpy
except ImportError:
    raise MissingExtra("windows are kept as safetensors: pip install 'nfc_gym[inference]'") from None

Batch = dict[str, NDArray]
MAPS = {"map": (None, None), "delta_e": (None, None)}
_DTYPES = {"F16": np.float16, "F32": np.float32, "F64": np.float64, "I16": np.int16, "I32": np.int32, "I64": np.int64}


def shard_path(folder: Path, shard: int) -> Path:
    """Where a shard lies."""
    return folder / f"shard_{shard:05d}.safetensors"


def packed(manifest: Manifest, arrays: Mapping[str, NDArray], counts: Mapping[str, int]) -> bytes:
    """A shard as the bytes of its file, after a check of every array.

    Raises:
      InputError: an array is missing, has another shape, or holds a number that is not finite.
    """
    shapes = manifest.shapes()
    if set(arrays) != set(shapes):
        raise InputError(f"a shard holds {', '.join(sorted(arrays))}; want {', '.join(sorted(shapes))}")
    for name, value in arrays.items():
        _check_shape(name, value.shape, shapes[name], "a shard")
        check_finite(name, value, "a shard")
    whole = {name: np.ascontiguousarray(value) for name, value in arrays.items()}
    # One entry: several would be written in an order that differs from one process to the next.
    return safetensors.numpy.save(whole, {"counts": json.dumps(dict(counts))})


def _check_shape(name: str, shape: Sequence[int], want: Sequence[int | None], where: str) -> None:
    same = len(shape) == 1 + len(want) and all(w in (None, n) for n, w in zip(shape[1:], want, strict=True))
    if not same:
        short = name in ("states", "actions", "pose") and len(shape) == 3 and want[0] and shape[1] < want[0]
        why = f": windows shorter than {want[0]} rows" if short else ""
        raise InputError(f"{where}: {name} has shape {tuple(shape)}, want (n, {', '.join(map(str, want))}){why}")


def check_finite(name: str, value: NDArray, where: str, rows: NDArray[np.integer] | None = None) -> None:
    """Refuse an array (n, ...) that holds a number which is not finite, naming the window: one of `rows` (n,)."""
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        row = int(np.argwhere(~np.isfinite(value))[0, 0])
        row = row if rows is None else int(rows[row])
        raise InputError(f"{where}: {name} of window {row} is not finite")


def maps_path(folder: Path, shard: int) -> Path:
    """Where the elevation maps of a shard's windows lie, where they are kept."""
    return folder / f"maps_{shard:05d}.safetensors"


class WindowWriter:
    """Writes a set shard by shard, each whole or not at all, and goes on where an earlier run stopped.

    Args:
      folder: made where it does not exist.
      manifest: of the whole set; `finished` is taken from what lies in the folder.

    Raises:
      InputError: the folder holds a set made otherwise.
    """

    def __init__(self, folder: Path, manifest: Manifest) -> None:
        self.folder, self.manifest = folder, manifest
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / MANIFEST).exists():
            before = Manifest.read(folder)
            # As the file would have it: JSON knows no tuples.
            now = json.loads(replace(manifest, finished=before.finished).text())
            odd = list(differences(json.loads(before.text()), now))
            if odd:
                raise InputError(
                    f"{folder}: holds windows that were made otherwise ({'; '.join(odd)}); give the same arguments to "
                    "go on, or another folder: Windows(first, second) reads both as one set"
                )
        else:  # maps that were left of other windows would be taken for those of the new ones
            for what, names in (("shards", "shard_*.safetensors"), ("elevation maps", "maps_*.safetensors")):
                if any(folder.glob(names)):
                    raise InputError(f"{folder}: holds {what} without a {MANIFEST}; choose another folder")
        self._save({k: c for k in range(manifest.shards) if (c := self._counts(k)) is not None})

    def _counts(self, shard: int) -> dict[str, int] | None:
        """What a shard that is there says of itself; a broken one is made anew."""
        path = shard_path(self.folder, shard)
        if not path.exists():
            return None
        try:
            with safetensors.safe_open(path, "np") as file:
                return json.loads((file.metadata() or {})["counts"])
        except (safetensors.SafetensorError, OSError, ValueError, KeyError):
            return None

    @property
    def missing(self) -> list[int]:
        """Shards that are still to be made."""
        return [k for k in range(self.manifest.shards) if k not in self.manifest.finished]

    def add(self, shard: int, data: bytes) -> dict[str, int]:
        """Write a shard that `packed` made, and return its counts."""
        with replacing(shard_path(self.folder, shard)) as part:
            part.write_bytes(data)
        counts = self._counts(shard)
        if counts is None:
            raise InputError(f"shard {shard}: these bytes are no shard")
        self._save({**self.manifest.finished, shard: counts})
        return counts

    def _save(self, finished: dict[int, dict[str, int]]) -> None:
        self.manifest = replace(self.manifest, finished=dict(sorted(finished.items())))
        write_whole(self.folder / MANIFEST, self.manifest.text())


def mapped(path: Path, shapes: Mapping[str, Sequence[int | None]], count: int) -> Batch:
    """The arrays of a shard's file, memory-mapped.

    Args:
      path: the file.
      shapes: trailing shape of each array that it must hold.
      count: windows that it must hold.

    Raises:
      InputError: the file is missing, truncated or foreign, or holds other arrays.
    """
    try:
        with safetensors.safe_open(path, "np") as file:  # compares the header with the file's length
            names = set(file.keys())
    except FileNotFoundError:
        raise InputError(f"{path}: missing, though {MANIFEST} says that it is finished; simulate again") from None
    except (safetensors.SafetensorError, OSError) as e:
        raise InputError(f"{path}: truncated, or no shard ({e}); delete it and simulate again") from None
    if names != set(shapes):
        raise InputError(f"{path}: holds {', '.join(sorted(names))}; want {', '.join(sorted(shapes))}")
    with open(path, "rb") as raw:
        length = struct.unpack("<Q", raw.read(8))[0]
        header = json.loads(raw.read(length))
    out: Batch = {}
    for name, want in shapes.items():
        entry = header[name]
        _check_shape(name, entry["shape"], want, str(path))
        if entry["shape"][0] != count:
            raise InputError(f"{path}: {name} has {entry['shape'][0]} windows, want {count}")
        begin = 8 + length + entry["data_offsets"][0]
        out[name] = np.memmap(path, _DTYPES[entry["dtype"]], "r", begin, tuple(entry["shape"]))
    return out


def save_maps(folder: Path, shard: int, maps: Mapping[str, NDArray]) -> None:
    """Keep the elevation maps of a shard's windows beside it, `map` and `delta_e` (n, rows, columns), as float16."""
    with replacing(maps_path(folder, shard)) as part:
        part.write_bytes(safetensors.numpy.save({k: np.ascontiguousarray(v, np.float16) for k, v in maps.items()}))
