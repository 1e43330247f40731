"""Maps as sums of cosines, each in units of its own spread: what the diffusion of delta_e sees as white noise.

Ground is smooth: between the longest and the shortest octave of a map of 128 cells its power falls by four orders. On
the scale of cells a diffusion drowns the fine octaves in its first steps and learns the coarse ones in its last
(Falck et al. 2025, "A Fourier space perspective on diffusion models"); in these units all octaves are drowned alike,
and a network that says 0 draws normal maps of the training set's mean and spectrum.
"""

import math

import torch
from torch import Tensor, nn

LEAST = 1e-3  # of the mean spread: finer waves than that are held to be as strong, lest rounding be magnified


class Waves(nn.Module):
    """Whitens maps (B, k, k): orthonormal cosines (DCT-II), standardised one by one over the training set.

    Args:
      cells: k.
    """

    mean: Tensor
    spread: Tensor
    cosines: Tensor

    def __init__(self, cells: int) -> None:
        super().__init__()
        at = torch.arange(cells, dtype=torch.float64)
        cosines = torch.cos(math.pi / cells * at[:, None] * (at + 0.5)) * math.sqrt(2 / cells)
        cosines[0] /= math.sqrt(2)
        self.register_buffer("cosines", cosines.float(), persistent=False)
        self.register_buffer("mean", torch.zeros(cells, cells))
        self.register_buffer("spread", torch.ones(cells, cells))

    def fit(self, maps: Tensor) -> None:
        """From samples (n, k, k)."""
        waves = self._turned(maps.float(), self.cosines)
        spread = waves.std(0, correction=0)
        self.mean.copy_(waves.mean(0))
        self.spread.copy_(spread.clamp(min=LEAST * float(spread.mean()) or 1.0))

    def forward(self, maps: Tensor) -> Tensor:
        """(B, k, k) of unit variance each, from maps in m."""
        return (self._turned(maps, self.cosines) - self.mean) / self.spread

    def inverse(self, waves: Tensor) -> Tensor:
        """Undo `forward`."""
        return self._turned(waves * self.spread + self.mean, self.cosines.T)

    def colour(self, waves: Tensor) -> Tensor:
        """What waves are as a map without the mean, in units of the maps' root mean square deviation."""
        return self._turned(waves * (self.spread / self.spread.square().mean().sqrt()), self.cosines.T)

    @staticmethod
    def _turned(maps: Tensor, by: Tensor) -> Tensor:
        with torch.autocast(maps.device.type, enabled=False):  # four orders of magnitude stand in one map
            return by @ maps.float() @ by.T
