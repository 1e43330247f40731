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

Where maps were kept (`nfc-gym simulate --maps`), `maps_00000.safetensors`, ... add `map`, the perceived elevation
(n, 128, 128) [m] at each window's end, and `delta_e`, truth minus perceived: float16 on disk, float32 when read.
Needs numpy and safetensors alone.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.inference.manifest import Manifest
from nfc_gym.inference.shards import MAPS, Batch, WindowWriter, check_finite, mapped, maps_path, packed, shard_path

__all__ = ["Batch", "Batches", "Manifest", "WindowWriter", "Windows", "packed", "shard_path"]

# What folders must have in common to be read as one: all that says what a number in them means.
ALIKE = (
    "environment", "psi_names", "psi_units", "psi_low", "psi_high", "horizon", "dt", "state_names", "action_names",
    "state_noise", "families", "effects", "terrain_kinds", "terrain_scale",
)  # fmt: skip


class Windows:
    """A set of windows, memory-mapped: nothing is read before it is asked for.

    Args:
      folders: what `nfc-gym simulate` wrote, perhaps not finished yet: what is there can be read. Several, as
        sequential rounds make them, are read one after the other.
      robot: name of the robot that the windows must be of; None is any.
      psi_names: of the parameters that they must have.

    Attributes:
      manifest: of the first folder, see `Manifest`.
      manifests: of all of them.

    Raises:
      InputError: no manifest, another robot or parameters than wanted, folders of different kinds, a truncated or
        foreign shard.
    """

    def __init__(self, *folders: str | Path, robot: str | None = None, psi_names: Sequence[str] | None = None) -> None:
        if not folders:
            raise InputError("windows: name a folder that `nfc-gym simulate` wrote")
        self.folders = tuple(Path(f) for f in folders)
        manifests = [Manifest.read(f) for f in self.folders]
        for folder, each in zip(self.folders, manifests, strict=True):
            _require(folder, each, manifests[0], robot, psi_names)
        self.manifest, self.manifests = manifests[0], tuple(manifests)
        opened = [_opened(f, m) for f, m in zip(self.folders, manifests, strict=True)]
        self._shards = [shard for shards in opened for shard in shards]
        kept = set.intersection(*(set(s) for s in self._shards))
        self.names = tuple(n for n in self._shards[0] if n in kept)
        self._ends = np.cumsum([len(s["family"]) for s in self._shards])

    def __len__(self) -> int:
        return int(self._ends[-1])

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
          InputError: a window or an array that does not exist, or a window that holds a number that is not finite.
        """
        if len(rows) and not (np.min(rows) >= 0 and np.max(rows) < len(self)):
            odd = rows[(rows < 0) | (rows >= len(self))][0]
            raise InputError(f"windows: there is no window {odd}; the indices are 0 to {len(self) - 1}")
        unknown = [n for n in names if n not in self.names]
        if unknown:
            raise InputError(f"windows have no array {unknown[0]!r}; there are: {', '.join(self.names)}")
        of = np.searchsorted(self._ends, rows, "right")
        starts = np.concatenate([[0], self._ends])
        out: Batch = {}
        for name in names or self.names:
            like = self._shards[0][name]
            kind = np.float32 if like.dtype == np.float16 else like.dtype
            value = np.empty((len(rows), *like.shape[1:]), kind)
            for k in np.unique(of):
                at = np.flatnonzero(of == k)
                value[at] = self._shards[k][name][rows[at] - starts[k]]
            check_finite(name, value, " + ".join(map(str, self.folders)), rows)
            out[name] = value
        return out

    def batches(
        self, size: int, seed: int = 0, rows: NDArray[np.integer] | None = None, names: Sequence[str] = (),
        noise: float = 1.0,
    ) -> "Batches":  # fmt: skip
        """Batches in shuffled order, see `Batches`."""
        return Batches(self, size, seed, np.arange(len(self)) if rows is None else rows, tuple(names), noise)


def _require(
    folder: Path, manifest: Manifest, first: Manifest, robot: str | None, psi_names: Sequence[str] | None
) -> None:
    """Refuse windows of another kind than wanted, or than those of the first folder."""
    if robot is not None and robot != manifest.robot:
        raise InputError(f"{folder}: windows of the robot {manifest.robot!r}, want {robot!r}")
    if psi_names is not None and tuple(psi_names) != manifest.psi_names:
        raise InputError(f"{folder}: the parameters are {', '.join(manifest.psi_names)}; want {', '.join(psi_names)}")
    odd = [k for k in ALIKE if getattr(manifest, k) != getattr(first, k)]
    if odd:
        raise InputError(f"{folder}: another {', '.join(odd)} than the first folder; such windows do not go together")
    if not manifest.finished:
        raise InputError(f"{folder}: no shard is finished yet")


def _opened(folder: Path, manifest: Manifest) -> list[Batch]:
    """Every shard's arrays; with the maps where all of them are kept."""
    done, shapes = manifest.finished, manifest.shapes()
    shards = [mapped(shard_path(folder, k), shapes, manifest.size(k)) for k in done]
    if all(maps_path(folder, k).exists() for k in done):
        kept = [mapped(maps_path(folder, k), MAPS, manifest.size(k)) for k in done]
        shards = [one | more for one, more in zip(shards, kept, strict=True)]
    return shards


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
