"""A trained posterior as the judge sees it, whoever trained it: draws and log densities for a batch of windows."""

import math
from typing import Protocol

import torch
from torch import Tensor

from nfc_gym.inference.data import Batch
from nfc_gym.inference.network import Network
from nfc_gym.inference.random import seeded
from nfc_gym.inference.space import EDGE

_WINDOWS = {False: 64, True: 1024}  # whose draws or densities are computed at once, on a processor and on a GPU


class Fitted(Protocol):
    """What is judged; u is psi's position in the prior's box, of the free parameters."""

    def draws(self, batch: Batch, n: int, seed: int) -> Tensor:
        """(B, n, d) u."""
        ...

    def gain(self, batch: Batch) -> Tensor:
        """(B,) log density of the true u, nats; the prior's is 0."""
        ...


def gain_of(z: Tensor, log_density: Tensor) -> Tensor:
    """log density of u from that of z = probit(u) at z (..., d): the change of variables divides by N(z; 0, I)."""
    return log_density + (z.square() + math.log(2 * math.pi)).sum(-1) / 2


def truth_of(u: Tensor) -> Tensor:
    """z of the true u."""
    return torch.special.ndtri(u.clamp(EDGE, 1 - EDGE))


class Ours:
    """A network of nfc_gym."""

    def __init__(self, network: Network) -> None:
        self.network = network.eval()

    def _parts(self, batch: Batch) -> list[Batch]:
        cut = {k: t.split(_WINDOWS[t.is_cuda]) for k, t in batch.items()}
        return [{k: cut[k][i] for k in cut} for i in range(len(cut["psi"]))]

    @torch.no_grad()
    def draws(self, batch: Batch, n: int, seed: int) -> Tensor:
        """See `Fitted`."""
        out = []
        with seeded(seed):
            for part in self._parts(batch):
                given = self.network.encode(part["states"], part["actions"], part.get("map"))
                z = self.network.sample(n, given, 1).double()
                out.append(torch.special.ndtr(z))
        return torch.cat(out)

    @torch.no_grad()
    def gain(self, batch: Batch) -> Tensor:
        """See `Fitted`."""
        out = []
        for part in self._parts(batch):
            given = self.network.encode(part["states"], part["actions"], part.get("map"))
            z = truth_of(part["psi"][:, self.network.free])
            out.append(gain_of(z, self.network.log_prob(z[:, None], given, 1)[:, 0]).double())
        return torch.cat(out)
