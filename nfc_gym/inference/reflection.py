"""Windows shown in a mirror while a network learns: for a robot that is its own mirror image, twice the windows."""

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


class Reflection:
    """Shows each window of a batch as it is or in a mirror, as torch's generator draws it.

    Args:
      states, actions: how their entries go over into one another; residuals of states (delta_s) go as these.
      psi: (d,) index of the parameter that goes to each place.
    """

    def __init__(self, states: Signed, actions: Signed, psi: Sequence[int] | NDArray) -> None:
        self._signed = {
            name: (torch.as_tensor(part.index), torch.as_tensor(part.sign, dtype=torch.float32))
            for name, part in (("states", states), ("actions", actions), ("delta_s", states))
        }
        self._psi = torch.as_tensor(psi)

    def to(self, device: torch.device) -> "Reflection":
        """The same on another device."""
        self._signed = {name: (i.to(device), s.to(device)) for name, (i, s) in self._signed.items()}
        self._psi = self._psi.to(device)
        return self

    def __call__(self, batch: Batch) -> Batch:
        """The batch, half of it in a mirror.

        Raises:
          InputError: it has elevation maps, which no mirror is known for.
        """
        if "map" in batch:
            raise InputError("training: windows with elevation maps are not shown in a mirror: mirror=None")
        chosen = torch.rand(len(batch["psi"]), device=batch["psi"].device) < 0.5
        return batch | {name: self._shown(name, value, chosen) for name, value in batch.items() if name != "family"}

    def _shown(self, name: str, value: Tensor, chosen: Tensor) -> Tensor:
        if name == "psi":
            mirrored = value[..., self._psi]
        else:
            index, sign = self._signed[name]
            mirrored = value[..., index] * sign
        return torch.where(chosen.reshape(-1, *[1] * (value.ndim - 1)), mirrored, value)
