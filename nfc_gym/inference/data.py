"""What training needs of a set of windows, and such a set from tensors in memory.

A batch is a dict of named tensors with a leading axis of windows:
  states   (B, H+1, s) and actions (B, H, a), float32, as the robot's log holds them
  psi      (B, d) float32, positions u in [0, 1] in the prior's box
  delta_s  (B, s) float32, residual of one control step (where it is inferred)
  delta_e  (B, 128, 128) float32, m, and `map` (B, 128, 128), the perceived elevation (where they are used)
  family   (B,) int16, index of the injected effect's family, 0 for none (where the structure head is trained)
"""

import hashlib
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import require_share
from nfc_gym.inference.random import mixed

Batch = dict[str, Tensor]
_AXES = {"states": 3, "actions": 3, "psi": 2, "delta_s": 2, "delta_e": 3, "map": 3, "family": 1}
_MAPS = ("map", "delta_e")
_APART = 3  # stream of random numbers
_READ = 4096  # windows that are read from disk at once
_ROOM = 0.4  # of a GPU's free memory, which windows may take


class WindowSet(Protocol):
    """A set of windows to train on, wherever it lies."""

    @property
    def manifest(self) -> Any:
        """What is known of the whole set."""
        ...

    def __len__(self) -> int:
        """Number of windows."""
        ...

    def batches(self, size: int, seed: int | None) -> Iterator[Batch]:
        """Every window once, in batches of `size` (the last may be smaller).

        The order is a function of `seed` alone; None is the order in which they are stored.
        """
        ...


class TensorWindows:
    """Windows held in memory, on any device.

    Args:
      tensors: a batch as above that holds all windows; arrays and other kinds of numbers are made float32 tensors.
      manifest: what is known of them.
      told: plain values, by name, in which training from other windows would be another training; without them it is
        by their `contents` that a saved state of training tells these windows from others.
      noise: (H+1, s), or (s,) for all times, standard deviation of what is added to the states anew in each pass; None
        adds nothing.

    Raises:
      InputError: a tensor has another number of axes or windows, states and actions do not belong together, or a
        value is not finite.
    """

    def __init__(
        self, tensors: Batch, manifest: Mapping[str, Any] | None = None, told: Mapping[str, Any] | None = None,
        noise: Tensor | None = None,
    ) -> None:  # fmt: skip
        tensors = {name: _tensor(name, value) for name, value in tensors.items()}
        require_batch(tensors)
        self.tensors, self.noise = tensors, noise
        self.manifest: Mapping[str, Any] = dict(manifest or {})
        self.told: dict[str, Any] = dict(told or {})

    def __len__(self) -> int:
        return len(self.tensors["psi"])

    @cached_property
    def contents(self) -> str:
        """A digest of all numbers: other windows have another."""
        found = hashlib.sha256()
        for name, tensor in sorted(self.tensors.items()):
            found.update(f"{name} {tuple(tensor.shape)} {tensor.dtype} ".encode())
            found.update(tensor.detach().cpu().flatten().view(torch.uint8).numpy().data)
        return found.hexdigest()[:16]

    def batches(self, size: int, seed: int | None) -> Iterator[Batch]:
        """See `WindowSet.batches`."""
        order = torch.arange(len(self))
        if seed is not None:
            order = order[torch.randperm(len(self), generator=torch.Generator().manual_seed(seed))]
        order = order.to(self.tensors["psi"].device)
        for i, rows in enumerate(order.split(size)):
            batch = {name: t[rows] for name, t in self.tensors.items()}
            if self.noise is not None:
                batch["states"] = self._noisy(batch["states"], mixed(seed or 0, i))
            yield batch

    def _noisy(self, states: Tensor, seed: int) -> Tensor:
        assert self.noise is not None  # the caller has asked
        drawn = torch.randn(states.shape, generator=torch.Generator(states.device).manual_seed(seed),
                            device=states.device)  # fmt: skip
        return states + self.noise.to(states) * drawn

    def split(self, share: float) -> tuple["TensorWindows", "TensorWindows"]:
        """The first windows, and the last `share` of them: to train on and to hold out; errors as of `cut_at`."""
        cut = cut_at(len(self), share)
        first, last = ({k: t[part] for k, t in self.tensors.items()} for part in (slice(cut), slice(cut, None)))
        return self._like(first), self._like(last)

    def append(self, other: "TensorWindows") -> "TensorWindows":
        """Both sets as one; they hold the same tensors, and get the same noise."""
        joined = {k: torch.cat([t, other.tensors[k].to(t.device)]) for k, t in self.tensors.items()}
        return self._like(joined)

    def to(self, device: str | torch.device) -> "TensorWindows":
        """The same on another device."""
        return self._like({k: t.to(device) for k, t in self.tensors.items()})

    def _like(self, tensors: Batch) -> "TensorWindows":
        return TensorWindows(tensors, self.manifest, self.told, self.noise)


class StoredWindows:
    """Some rows of a stored set, read as they are needed: numpy batches made tensors.

    Args:
      stored: has `manifest`, a length and `batches(size, seed, rows, names, noise)`, which gives dicts of arrays.
      rows: (k,) which windows; default all.
      maps: read the elevation maps too: `map`, as perceived, and `delta_e`, truth minus perceived.
      noise: what multiplies the sensor noise that the set's manifest assumes.

    Raises:
      InputError: the set holds no maps and they are asked for, or a noise below 0.
    """

    def __init__(
        self, stored: Any, rows: NDArray[np.integer] | None = None, maps: bool = False, noise: float = 1.0
    ) -> None:
        if not 0 <= noise < np.inf:
            raise InputError(f"windows: noise multiplies the sensors' own, want 0 or more, got {noise!r}")
        self.stored, self.manifest, self.maps, self.noise = stored, stored.manifest, maps, noise
        self.rows = np.arange(len(stored)) if rows is None else rows
        missing = [n for n in _MAPS if n not in stored.names]
        if maps and missing:
            raise InputError(f"windows: the set holds no maps ({missing[0]!r} is missing); simulate with --maps")
        self.names = tuple(n for n in stored.names if n in _AXES and (maps or n not in _MAPS))

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def told(self) -> dict[str, Any]:
        """Which windows these are, as far as training from others would be another training."""
        found = {"environment": self.manifest.environment, "noise": self.noise}
        for k, about in enumerate(getattr(self.stored, "manifests", (self.manifest,))):
            whose = f"the windows' {{}}{f' in folder {k + 1}' if k else ''}"
            found |= {whose.format(key): value for key, value in ({"seed": about.seed} | about.settings).items()}
        return found

    def batches(self, size: int, seed: int | None) -> Iterator[Batch]:
        """See `WindowSet.batches`; None is an order of its own, the same each time."""
        for arrays in self.stored.batches(size, 0 if seed is None else seed, self.rows, self.names, self.noise):
            yield {name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in arrays.items()}

    def first(self) -> Batch:
        """The first window alone, without noise."""
        return next(iter(self._of(self.rows[:1], 0.0).batches(1, None)))

    def held(self, device: str | torch.device) -> TensorWindows:
        """All of them in the memory of a device, to which noise like the stored set's is added in each pass."""
        tensors, at = {k: t.new_empty((len(self), *t.shape[1:]), device=device) for k, t in self.first().items()}, 0
        for part in self._of(self.rows, 0.0).batches(_READ, None):
            for name, tensor in part.items():
                tensors[name][at : at + len(tensor)] = tensor
            at += len(part["psi"])
        noise = self.noise * torch.tensor(self.manifest.state_noise, dtype=torch.float32)
        return TensorWindows(tensors, told=self.told, noise=noise.to(device) if noise.any() else None)

    def split(self, share: float) -> tuple["StoredWindows", "StoredWindows"]:
        """The first windows, and the last `share` of them: to train on and to hold out; errors as of `cut_at`."""
        cut = cut_at(len(self), share)
        return self._of(self.rows[:cut]), self._of(self.rows[cut:])

    def apart(self, n: int, seed: int) -> tuple["StoredWindows", "StoredWindows"]:
        """All but `n` windows, in their order, and those: drawn at random, a function of `seed` alone."""
        drawn = np.zeros(len(self), bool)
        drawn[np.random.default_rng([seed, _APART]).choice(len(self), n, replace=False)] = True
        return self._of(self.rows[~drawn]), self._of(self.rows[drawn])

    def _of(self, rows: NDArray[np.integer], noise: float | None = None) -> "StoredWindows":
        return StoredWindows(self.stored, rows, self.maps, self.noise if noise is None else noise)


def resident(windows: WindowSet, device: torch.device) -> WindowSet:
    """The same windows in a GPU's memory, where there is room for them; elsewhere, and on a processor, as they are.

    Those on disk then get their sensors' noise from torch's generator in place of numpy's, and another order.
    """
    if device.type != "cuda":
        return windows
    if type(windows) is TensorWindows:
        return windows.to(device) if _fits(windows.tensors, 1, device) else windows
    if type(windows) is StoredWindows and _fits(windows.first(), 1 / len(windows), device):
        return windows.held(device)
    return windows


def _fits(tensors: Batch, share: float, device: torch.device) -> bool:
    """Whether there is room for windows of which these are a share."""
    return sum(t.nbytes for t in tensors.values()) / share <= _ROOM * torch.cuda.mem_get_info(device)[0]


def cut_at(windows: int, share: float) -> int:
    """How many windows are left to train on where a share of them is held out, one at least.

    Raises:
      InputError: the share is none, or leaves no window.
    """
    require_share("windows: the share held out", share)
    left = windows - max(1, round(share * windows))
    if left < 1:
        raise InputError(
            f"windows: of {windows} a share of {share:g} is held out, one at least: none is left to train on"
        )
    return left


def _tensor(name: str, value: Any) -> Tensor:
    """A batch's entry as networks take it; one that is so already stays the same tensor."""
    try:
        if isinstance(value, np.ndarray):  # torch takes none that run backwards, or have another machine's byte order
            value = np.ascontiguousarray(value, value.dtype.newbyteorder("="))
        tensor = torch.as_tensor(value)
    except (TypeError, ValueError) as e:
        raise InputError(f"windows: {name} must be an array of numbers ({e})") from None
    return tensor.float() if name in _AXES and name != "family" else tensor


def require_batch(tensors: Batch) -> None:
    """Refuse what is no batch of windows, naming what is wrong.

    Raises:
      InputError: see `TensorWindows`.
    """
    missing = sorted({"states", "actions", "psi"} - set(tensors))
    if missing:
        raise InputError(f"windows: {missing[0]!r} is missing; a batch has {', '.join(_AXES)}, the first three always")
    for name, tensor in tensors.items():
        if name in _AXES and tensor.ndim != _AXES[name]:
            raise InputError(f"windows: {name} must have {_AXES[name]} axes, got shape {tuple(tensor.shape)}")
        if tensor.is_floating_point() and not torch.isfinite(tensor).all():
            raise InputError(f"windows: {name} holds NaN or infinity; every entry must be finite")
    rows = {name: len(tensor) for name, tensor in tensors.items()}
    if len(set(rows.values())) > 1 or not rows["psi"]:
        raise InputError(f"windows: the tensors hold different numbers of windows, or none: {rows}")
    if tensors["states"].shape[1] != tensors["actions"].shape[1] + 1:
        raise InputError(
            f"windows: H + 1 states go with H actions, got {tensors['states'].shape[1]} and "
            f"{tensors['actions'].shape[1]}"
        )
    low, high = float(tensors["psi"].min()), float(tensors["psi"].max())
    if low < 0 or high > 1:
        raise InputError(f"windows: psi holds positions in the prior's box, in [0, 1], got [{low:g}, {high:g}]")
