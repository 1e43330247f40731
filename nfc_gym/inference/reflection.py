"""Windows shown in mirrors while a network learns: each in which a robot is its own image makes them twice as many."""

from collections.abc import Sequence
from typing import Protocol

import torch
from numpy.typing import NDArray
from torch import Tensor

from nfc_gym.core.errors import InputError
from nfc_gym.inference.data import Batch


class Signed(Protocol):
    """Entries that change places and signs (`envs.mirror.Signed`)."""

    @property
    def index(self) -> NDArray:
        """(k,) of the entry that goes to each place."""
        ...

    @property
    def sign(self) -> NDArray:
        """(k,) 1 or -1."""
        ...


class Mirror(Protocol):
    """How windows look in one mirror (`envs.mirror.Mirror`)."""

    @property
    def states(self) -> Signed:
        """How their entries go over into one another; residuals of states (delta_s) go as these."""
        ...

    @property
    def actions(self) -> Signed:
        """The same of actions."""
        ...

    @property
    def psi(self) -> NDArray:
        """(d,) index of the parameter that goes to each place."""
        ...


class _Image:
    """One mirror, on a device."""

    def __init__(self, mirror: Mirror) -> None:
        self._signed = {
            name: (torch.as_tensor(part.index), torch.as_tensor(part.sign, dtype=torch.float32))
            for name, part in (("states", mirror.states), ("actions", mirror.actions), ("delta_s", mirror.states))
        }
        self._psi = torch.as_tensor(mirror.psi)

    def to(self, device: torch.device) -> None:
        self._signed = {name: (i.to(device), s.to(device)) for name, (i, s) in self._signed.items()}
        self._psi = self._psi.to(device)

    def __call__(self, batch: Batch) -> Batch:
        chosen = torch.rand(len(batch["psi"]), device=batch["psi"].device) < 0.5
        return batch | {name: self._shown(name, value, chosen) for name, value in batch.items() if name != "family"}

    def _shown(self, name: str, value: Tensor, chosen: Tensor) -> Tensor:
        if name == "psi":
            mirrored = value[..., self._psi]
        else:
            index, sign = self._signed[name]
            mirrored = value[..., index] * sign
        return torch.where(chosen.reshape(-1, *[1] * (value.ndim - 1)), mirrored, value)


class Reflection:
    """Shows windows of a batch in mirrors, each window in each of them or not, as torch's generator draws it.

    Args:
      mirrors: one or more; of two, a quarter of the windows stays as it is.
    """

    def __init__(self, mirrors: Sequence[Mirror]) -> None:
        self._images = [_Image(mirror) for mirror in mirrors]

    def __len__(self) -> int:
        """How many mirrors."""
        return len(self._images)

    def to(self, device: torch.device) -> "Reflection":
        """The same on another device."""
        for image in self._images:
            image.to(device)
        return self

    def __call__(self, batch: Batch) -> Batch:
        """The batch, half of it in the first mirror, and half of either half in the next.

        Raises:
          InputError: it has elevation maps, which no mirror is known for.
        """
        if "map" in batch:
            raise InputError("training: windows with elevation maps are not shown in a mirror: mirror=None")
        for image in self._images:
            batch = image(batch)
        return batch
