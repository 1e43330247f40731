"""Fixed kernel features of a window, by quasi-Monte Carlo: random Fourier features and kernel slicing.

Both stand for the Gaussian kernel exp(-|x - y|^2 / (2 width^2)) of the flattened, standardised window, of which they
take 1024 numbers that no training changes (paper, appendix "Radial Kernel"). They see no map.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import gammaincinv
from torch import Tensor

from nfc_gym.inference.encoders.base import SignalEncoder

FEATURES = 1024
_LARGEST = torch.quasirandom.SobolEngine.MAXDIM
_NODES = 32  # of the mean over r
_PAIRS = 512  # windows of which the median distance is taken


def sobol_normal(n: int, size: int, seed: int = 0) -> Tensor:
    """(n, size) points of a scrambled Sobol sequence, mapped to N(0, I); dimensions past the table's are random."""
    points = torch.quasirandom.SobolEngine(min(size, _LARGEST), scramble=True, seed=seed).draw(n, dtype=torch.float64)
    if size > _LARGEST:
        more = torch.rand(n, size - _LARGEST, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
        points = torch.cat([points, more], 1)
    return torch.special.ndtri(points.clamp(1e-9, 1 - 1e-9))


class KernelFeatures(SignalEncoder):
    """Features of projections <x, direction> / width; the width is the median distance between training windows.

    Args:
      horizon: H.
      states: s.
      actions: a.
    """

    features = FEATURES
    directions: Tensor
    width: Tensor

    def __init__(self, horizon: int, states: int, actions: int) -> None:
        super().__init__(horizon, states, actions)
        self.size = self.length * self.channels
        self.register_buffer("directions", self.spread_directions().float())
        self.register_buffer("width", torch.tensor(math.sqrt(self.size)))

    def spread_directions(self) -> Tensor:
        """(p, size) directions to project on."""
        raise NotImplementedError

    def fit(self, states: Tensor, actions: Tensor, elevation: Tensor | None) -> None:
        """Scales, and the kernel's width by the median heuristic."""
        super().fit(states, actions, elevation)
        x = self.signals(states[:_PAIRS], actions[:_PAIRS]).flatten(1)
        if len(x) > 1:
            self.width.copy_(torch.pdist(x).median().clamp(min=1e-3))

    def projections(self, x: Tensor) -> Tensor:
        """(B, p) in units of the kernel's width; phases, which bfloat16 would spoil."""
        with torch.autocast(x.device.type, enabled=False):
            return x.flatten(1) @ self.directions.T / self.width


class RFF(KernelFeatures):
    """Random Fourier features: sqrt(2) cos and sin of <x, v>, v ~ N(0, I / width^2) (Rahimi and Recht 2007).

    The mean over the features of their products is the kernel.
    """

    def spread_directions(self) -> Tensor:
        """512 frequencies."""
        return sobol_normal(FEATURES // 2, self.size)

    def embed(self, x: Tensor) -> Tensor:
        """(B, 1024)."""
        p = self.projections(x)
        return math.sqrt(2) * torch.cat([p.cos(), p.sin()], 1)


class FKS(KernelFeatures):
    """Kernel slicing: the one-dimensional basis function of the sliced Gaussian along directions on the sphere.

    exp(-|x - y|^2 / 2) is the mean over directions xi of f(<xi, x - y>), where f(t) = E cos(r t) =
    1F1(d/2; 1/2; -t^2/2) and r is distributed as the norm of a Gaussian vector in R^d (Hertrich 2024). The paper's
    features f(<xi, x>) are even and cannot tell x from -x; the slices here are signed: each direction gives f and its
    odd partner E sin(r t).
    """

    radii: Tensor

    def __init__(self, horizon: int, states: int, actions: int) -> None:
        super().__init__(horizon, states, actions)
        self.register_buffer("radii", torch.as_tensor(chi_quantiles(self.size, _NODES), dtype=torch.float32))

    def spread_directions(self) -> Tensor:
        """512 unit vectors."""
        return torch.nn.functional.normalize(sobol_normal(FEATURES // 2, self.size), dim=1)

    def embed(self, x: Tensor) -> Tensor:
        """(B, 1024), scaled to a mean square near 1."""
        phase = self.projections(x)[..., None] * self.radii
        return math.sqrt(2) * torch.cat([phase.cos().mean(-1), phase.sin().mean(-1)], 1)


def chi_quantiles(size: int, n: int) -> NDArray[np.float64]:
    """(n,) norms of a standard Gaussian vector in R^size, at n equal steps of probability."""
    return np.sqrt(2 * gammaincinv(size / 2, (np.arange(n) + 0.5) / n))
