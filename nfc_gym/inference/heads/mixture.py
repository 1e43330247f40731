"""Mixture density network with full covariances (Bishop 1994), the density that the paper compares with."""

import math

import torch
from torch import Tensor, nn

from nfc_gym.inference.heads.density import Explicit

LEAST = 1e-3  # smallest diagonal entry of a Cholesky factor of the precision's inverse, in units of the prior


class Mixture(Explicit):
    """A mixture of Gaussians of one block; weights, means and Cholesky factors of the precisions are a network's.

    Args:
      size: d.
      features: F.
      hidden: width of the two hidden layers.
      components: how many Gaussians.
    """

    def __init__(self, size: int, features: int, hidden: int = 256, components: int = 8) -> None:
        super().__init__((size,), features)
        self.components = components
        self.register_buffer("below", torch.tril_indices(size, size, -1), persistent=False)
        self.each = 1 + 2 * size + size * (size - 1) // 2
        self.body = nn.Sequential(nn.Linear(features, hidden), nn.GELU(), nn.Linear(hidden, hidden), nn.GELU())
        self.out = nn.Linear(hidden, components * self.each)
        # Starts near the prior: means a little apart, since equal components would stay equal.
        nn.init.normal_(self.out.weight, std=1e-3)
        nn.init.zeros_(self.out.bias)
        with torch.no_grad():
            self.out.bias.view(components, self.each)[:, 1 : 1 + size].normal_(std=0.1)

    def parts(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Log weights (B, K), means (B, K, d), lower factors (B, K, d, d) L of the precisions L L^T."""
        with torch.autocast(features.device.type, enabled=False):
            d = self.sizes[0]
            out = self.out(self.body(features.float())).view(len(features), self.components, self.each)
            log_weights, means, logs, below = out.split([1, d, d, d * (d - 1) // 2], -1)
            factors = torch.diag_embed(logs.clamp(max=-math.log(LEAST)).exp())
            rows, columns = self.below  # type: ignore[misc]
            factors[..., rows, columns] = below
            return log_weights[..., 0].log_softmax(-1), means, factors

    def log_prob(self, x: Tensor, features: Tensor, blocks: int | None = None) -> Tensor:
        """See `Density`."""
        log_weights, means, factors = self.parts(features)
        away = x[:, :, None] - means[:, None]  # (B, n, K, d)
        white = torch.einsum("bkij,bnki->bnkj", factors, away)
        scale = factors.diagonal(dim1=-2, dim2=-1).log().sum(-1) - self.sizes[0] / 2 * math.log(2 * math.pi)
        return torch.logsumexp((log_weights + scale)[:, None] - white.square().sum(-1) / 2, -1)

    def sample(self, n: int, features: Tensor, blocks: int | None = None) -> Tensor:
        """See `Density`."""
        log_weights, means, factors = self.parts(features)
        which = torch.multinomial(log_weights.exp(), n, replacement=True)  # (B, n)
        row = torch.arange(len(features), device=features.device)[:, None]
        noise = torch.randn(*which.shape, self.sizes[0], 1, device=features.device)
        spread = torch.linalg.solve_triangular(factors.mT[row, which], noise, upper=True)
        return means[row, which] + spread[..., 0]
