"""Training sets on disk: windows of simulated motion with the fidelity under which they were made.

A folder holds `manifest.json` and shards `shard_00000.safetensors`, ... Each shard has these arrays, n windows each:

| array | shape | what |
|---|---|---|
| states | (n, H + 1, s) float32 | the observation `proprio` at each control step, free of measurement noise |
| actions | (n, H, a) float32 | in [-1, 1], held for a control step |
| psi | (n, d) float32 | u in [0, 1]: (psi - low) / (high - low) |
| delta_s | (n, s) float32 | mean residual of one control step over the window: with the effect minus without |
| family | (n,) int16 | of the injected effect, index into the manifest's `families`; 0 is none |
| effect | (n,) int16 | which of the manifest's `effects` (family and place); -1 is none |
| theta | (n, k) float32 | its parameters in the order of the manifest, then zeros |
| terrain_kind | (n,) int16 | index into the manifest's `terrain_kinds`; -1 is a plane |
| terrain_seed, terrain_difficulty | (n,) int64, float32 | arguments of `nfc_gym.terrain.make` |
| pose | (n, H + 1, 7) float32 | the base's position [m] and quaternion, along which elevation maps are rebuilt |
| camera_seed, camera_level | (n,) int64, float32 | of the depth camera's noise; what multiplies it |
| start | (n, m) float64 | the simulator's whole state at the window's beginning (MuJoCo's integration state) |

Needs numpy and safetensors alone.
"""

import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError, MissingExtra
from nfc_gym.core.files import replacing, write_whole

try:
    import safetensors
    import safetensors.numpy
except ImportError:
    raise MissingExtra("windows are kept as safetensors: pip install 'nfc_gym[inference]'") from None

FORMAT = 1
MANIFEST = "manifest.json"
Batch = dict[str, NDArray]
_DTYPES = {"F32": np.float32, "F64": np.float64, "I16": np.int16, "I32": np.int32, "I64": np.int64}


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What the windows of a folder are.

    Attributes:
      environment, robot, rough: id, name of the robot, and whether it moves on rough ground.
      psi_names, psi_units, psi_low, psi_high: the box that u in [0, 1] stands for, d each.
      horizon: H, control steps a window.
      dt: control step, s.
      state_names, action_names: s and a of them; `obs` is what no part of the physical state stands behind alone.
      state_noise: (s,) standard deviation of the measurement noise that readers add, 0 for what is known exactly.
      families: names; the first is `none`.
      effects: of each pair of family and place: `family`, `where`, `parameters` (names), `units`.
      terrain_kinds, terrain_scale: names, and what multiplies all heights.
      seed, windows, per_shard: the run's seed, and how many windows were asked for, in all and per shard.
      settings: what else the windows depend on.
      versions: of the packages that made them.
      finished: shard -> counts (`windows`, `unstable`, `ended`, `relabelled`).
      format: of these files.
    """

    environment: str
    robot: str
    rough: bool
    psi_names: tuple[str, ...]
    psi_units: tuple[str, ...]
    psi_low: tuple[float, ...]
    psi_high: tuple[float, ...]
    horizon: int
    dt: float
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    state_noise: tuple[float, ...]
    families: tuple[str, ...]
    effects: tuple[dict[str, Any], ...]
    terrain_kinds: tuple[str, ...]
    terrain_scale: float
    seed: int
    windows: int
    per_shard: int
    settings: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    finished: dict[int, dict[str, int]] = field(default_factory=dict)
    format: int = FORMAT

    @property
    def shards(self) -> int:
        """How many shards the whole set has."""
        return -(-self.windows // self.per_shard)

    @property
    def complete(self) -> bool:
        """Whether every shard is there."""
        return len(self.finished) == self.shards

    def size(self, shard: int) -> int:
        """Windows of a shard: the last one holds what is left."""
        return min(self.per_shard, self.windows - shard * self.per_shard)

    def shapes(self) -> dict[str, tuple[int | None, ...]]:
        """Trailing shape of each array; None is any."""
        s, a, d, h = len(self.state_names), len(self.action_names), len(self.psi_names), self.horizon
        scalars = ("family", "effect", "terrain_kind", "terrain_seed", "terrain_difficulty", "camera_seed")
        return {
            "states": (h + 1, s), "actions": (h, a), "psi": (d,), "delta_s": (s,), "theta": (None,),
            "pose": (h + 1, 7), "start": (None,), **dict.fromkeys(scalars, ()), "camera_level": (),
        }  # fmt: skip

    def text(self) -> str:
        """As JSON."""
        return json.dumps(asdict(self), indent=1)

    @classmethod
    def read(cls, folder: Path) -> "Manifest":
        """The manifest of a folder.

        Raises:
          InputError: there is none, it is not JSON, of another format, or lacks a key.
        """
        path = folder / MANIFEST
        try:
            raw = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise InputError(f"{folder}: no {MANIFEST}; want a folder that `nfc-gym simulate` wrote") from None
        except (OSError, ValueError) as e:
            raise InputError(f"{path}: cannot be read ({e})") from None
        found = raw.get("format") if isinstance(raw, dict) else None
        if found != FORMAT:
            raise InputError(f"{path}: format {found!r}, and this version of nfc_gym reads format {FORMAT}")
        names = {f.name for f in fields(cls)}
        odd = sorted(names ^ set(raw))
        if odd:
            raise InputError(f"{path}: the keys {', '.join(odd)} are missing or unknown")
        values = {k: tuple(v) if isinstance(v, list) else v for k, v in raw.items()}
        values["finished"] = {int(k): v for k, v in values["finished"].items()}
        return cls(**values)


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
        _check_finite(name, value, "a shard")
    whole = {name: np.ascontiguousarray(value) for name, value in arrays.items()}
    # One entry: several would be written in an order that differs from one process to the next.
    return safetensors.numpy.save(whole, {"counts": json.dumps(dict(counts))})


def _check_shape(name: str, shape: Sequence[int], want: Sequence[int | None], where: str) -> None:
    same = len(shape) == 1 + len(want) and all(w in (None, n) for n, w in zip(shape[1:], want, strict=True))
    if not same:
        short = name in ("states", "actions", "pose") and len(shape) == 3 and want[0] and shape[1] < want[0]
        why = f": windows shorter than {want[0]} rows" if short else ""
        raise InputError(f"{where}: {name} has shape {tuple(shape)}, want (n, {', '.join(map(str, want))}){why}")


def _check_finite(name: str, value: NDArray, where: str) -> None:
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        row = int(np.argwhere(~np.isfinite(value))[0, 0])
        raise InputError(f"{where}: {name} of window {row} is not finite")


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
            odd = [k for k, v in json.loads(before.text()).items() if v != now[k]]
            if odd:
                raise InputError(
                    f"{folder}: holds windows made with another {', '.join(odd)}; choose another folder, or the same "
                    "arguments to go on"
                )
        elif any(folder.glob("shard_*.safetensors")):
            raise InputError(f"{folder}: holds shards without a {MANIFEST}; choose another folder")
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


class Windows:
    """A set of windows, memory-mapped: nothing is read before it is asked for.

    Args:
      folder: what `nfc-gym simulate` wrote, perhaps not finished yet: what is there can be read.
      robot: name of the robot that the windows must be of; None is any.
      psi_names: of the parameters that they must have.

    Attributes:
      manifest: see `Manifest`.

    Raises:
      InputError: no or another manifest, a robot or parameters other than wanted, a truncated or foreign shard.
    """

    def __init__(self, folder: str | Path, robot: str | None = None, psi_names: Sequence[str] | None = None) -> None:
        self.folder = Path(folder)
        self.manifest = Manifest.read(self.folder)
        if robot is not None and robot != self.manifest.robot:
            raise InputError(f"{self.folder}: windows of the robot {self.manifest.robot!r}, want {robot!r}")
        if psi_names is not None and tuple(psi_names) != self.manifest.psi_names:
            raise InputError(
                f"{self.folder}: the parameters are {', '.join(self.manifest.psi_names)}; want {', '.join(psi_names)}"
            )
        if not self.manifest.finished:
            raise InputError(f"{self.folder}: no shard is finished yet")
        self._shards = [_mapped(shard_path(self.folder, k), self.manifest, k) for k in self.manifest.finished]
        self._ends = np.cumsum([len(s["family"]) for s in self._shards])

    def __len__(self) -> int:
        return int(self._ends[-1])

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The arrays that each window has."""
        return tuple(self._shards[0])

    def __getitem__(self, rows: Any) -> Batch:
        """Windows by index, slice or array of indices: every array, in the order asked for."""
        index = np.arange(len(self))[rows]
        if np.ndim(index):
            return self.take(index)
        return {name: value[0] for name, value in self.take(index[None]).items()}

    def take(self, rows: NDArray[np.integer], names: Sequence[str] = ()) -> Batch:
        """Copies of some windows' arrays.

        Args:
          rows: (k,) indices, 0 to len - 1, in any order.
          names: which arrays; none is all.

        Raises:
          InputError: a window that holds a number that is not finite, or an array that does not exist.
        """
        unknown = [n for n in names if n not in self.names]
        if unknown:
            raise InputError(f"windows have no array {unknown[0]!r}; there are: {', '.join(self.names)}")
        of = np.searchsorted(self._ends, rows, "right")
        starts = np.concatenate([[0], self._ends])
        out: Batch = {}
        for name in names or self.names:
            like = self._shards[0][name]
            value = np.empty((len(rows), *like.shape[1:]), like.dtype)
            for k in np.unique(of):
                at = np.flatnonzero(of == k)
                value[at] = self._shards[k][name][rows[at] - starts[k]]
            _check_finite(name, value, str(self.folder))
            out[name] = value
        return out

    def batches(
        self, size: int, seed: int = 0, rows: NDArray[np.integer] | None = None, names: Sequence[str] = (),
        noise: float = 1.0,
    ) -> "Batches":  # fmt: skip
        """Batches in shuffled order, see `Batches`."""
        return Batches(self, size, seed, np.arange(len(self)) if rows is None else rows, tuple(names), noise)


@dataclass
class Batches:
    """Batches of windows, shuffled anew with each pass; the same seed gives the same order and noise.

    Attributes:
      windows: where they come from.
      size: windows a batch; the last of a pass holds what is left.
      seed, epoch: what the next pass is shuffled by; the epoch counts up, and may be set to go on in the middle.
      rows: which windows.
      names: which arrays; none is all.
      noise: what multiplies the manifest's `state_noise`, drawn anew with each pass and added to `states`; 0 adds none.
    """

    windows: Windows
    size: int
    seed: int
    rows: NDArray[np.integer]
    names: tuple[str, ...] = ()
    noise: float = 1.0
    epoch: int = 0

    def __post_init__(self) -> None:
        if self.size < 1 or not len(self.rows):
            raise InputError(f"batches of {self.size} out of {len(self.rows)} windows; want 1 or more of each")

    @property
    def manifest(self) -> Manifest:
        """What the windows are."""
        return self.windows.manifest

    def __len__(self) -> int:
        return -(-len(self.rows) // self.size)

    def __iter__(self) -> Iterator[Batch]:
        rng = np.random.default_rng([self.seed, self.epoch])
        self.epoch += 1
        order = rng.permutation(self.rows)
        sd = self.noise * np.array(self.manifest.state_noise, np.float32)
        for i in range(0, len(order), self.size):
            batch = self.windows.take(order[i : i + self.size], self.names)
            if "states" in batch and sd.any():
                batch["states"] += sd * rng.standard_normal(batch["states"].shape, np.float32)
            yield batch


def _mapped(path: Path, manifest: Manifest, shard: int) -> Batch:
    """The arrays of a shard's file, memory-mapped."""
    try:
        with safetensors.safe_open(path, "np") as file:  # compares the header with the file's length
            names = set(file.keys())
    except FileNotFoundError:
        raise InputError(f"{path}: missing, though {MANIFEST} says that it is finished; simulate again") from None
    except (safetensors.SafetensorError, OSError) as e:
        raise InputError(f"{path}: truncated, or no shard ({e}); delete it and simulate again") from None
    shapes = manifest.shapes()
    if names != set(shapes):
        raise InputError(f"{path}: holds {', '.join(sorted(names))}; want {', '.join(sorted(shapes))}")
    with open(path, "rb") as raw:
        length = struct.unpack("<Q", raw.read(8))[0]
        header = json.loads(raw.read(length))
    out: Batch = {}
    for name, want in shapes.items():
        entry = header[name]
        _check_shape(name, entry["shape"], want, str(path))
        if entry["shape"][0] != manifest.size(shard):
            raise InputError(f"{path}: {name} has {entry['shape'][0]} windows, want {manifest.size(shard)}")
        begin = 8 + length + entry["data_offsets"][0]
        out[name] = np.memmap(path, _DTYPES[entry["dtype"]], "r", begin, tuple(entry["shape"]))
    return out
