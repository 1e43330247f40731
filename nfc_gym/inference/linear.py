"""What a linear regression already tells: the coordinates in which a density starts from a Gaussian posterior."""

import torch
from torch import Tensor, nn

from nfc_gym.inference.encoders.base import Standard

_STRENGTHS = torch.logspace(-7, 2, 28, dtype=torch.float64).tolist()  # of the ridge, in units of the inputs' variance
_LEAST = 3  # pairs
# Where there are fewer pairs than inputs a weak ridge goes through each, and what it leaves of one and what that one
# has no say in are both next to nothing: only their ratio tells, and is good to many digits.
_LEVERAGE = 1e-12


class LinearBase(nn.Module):
    """x = W r + b + L y: ridge regression of x on fixed inputs r, and the spread of what it leaves.

    A density of y in place of x starts, where a network starts at N(0, I), at the linear-Gaussian posterior N(W r + b,
    L L^T): what is linear is exact from the first step, a posterior much narrower than the prior is of order 1 to the
    network, and the network learns the rest. An x of which r tells nothing has W = 0 and keeps its prior. L is lower
    triangular, so the first entries of y depend on the first entries of x alone, and marginal densities stay exact.

    The ridge is the one of least leave-one-out error, and L is the Cholesky factor of the leave-one-out residuals'
    covariance: what a regression gains by overfitting does not narrow it. Nor do few windows: the fewer there are to an
    entry of x, the less of the residuals' correlations is believed, and from fewer than three nothing is learned.

    Args:
      inputs: size of r.
      size: D of x.
    """

    weight: Tensor
    offset: Tensor
    factor: Tensor

    def __init__(self, inputs: int, size: int) -> None:
        super().__init__()
        self.scale = Standard(inputs)
        self.register_buffer("weight", torch.zeros(size, inputs))
        self.register_buffer("offset", torch.zeros(size))
        self.register_buffer("factor", torch.eye(size))

    @torch.no_grad()
    def fit(self, r: Tensor, x: Tensor) -> None:
        """From pairs r (n, inputs), x (n, D)."""
        self.scale.fit(r)
        if len(r) < _LEAST:
            return
        a, x = self._inputs(r).double(), x.double()
        middle, at = x.mean(0), a.mean(0)
        values, vectors = torch.linalg.eigh((a - at).T @ (a - at) / len(a))
        values = values.clamp(min=0)
        turned = (a - at) @ vectors  # (n, inputs)
        moments = turned.T @ (x - middle) / len(a)
        best, left = torch.inf, x - middle
        for strength in _STRENGTHS:
            inverse = 1 / (values + strength)
            leverage = 1 / len(a) + (turned.square() * inverse).sum(1, keepdim=True) / len(a)
            wrong = (x - middle - turned @ (inverse[:, None] * moments)) / (1 - leverage).clamp(min=_LEVERAGE)
            error = wrong.square().sum(0).log().sum()  # each entry in units of its own: scale-free
            if error < best:
                best, left = error, wrong
                weight = ((vectors * inverse) @ moments).T
                self.weight.copy_(weight)
                self.offset.copy_(middle - weight @ at)
        covariance = left.T @ left / len(a)
        few = min(1.0, (covariance.shape[0] + 2) / len(a)) ** 2
        covariance = (1 - few) * covariance + few * covariance.diagonal().diag()
        ridge = 1e-6 * covariance.diagonal().mean() * torch.eye(len(covariance), device=x.device)
        self.factor.copy_(torch.linalg.cholesky(covariance + ridge))

    @torch.no_grad()
    def leave(self, entries: Tensor) -> None:
        """Take some entries of x (D,) bool out again: they stay as they are, and touch no other."""
        for part in (self.weight, self.offset, self.factor, self.factor.mT):
            part[entries] = 0
        self.factor.diagonal()[entries] = 1

    def _inputs(self, r: Tensor) -> Tensor:
        return self.scale(r).clamp(-10, 10)

    def forward(self, r: Tensor) -> Tensor:
        """Means (B, D) of x; summed in double, whatever the products of networks are rounded to."""
        return (self._inputs(r).double() @ self.weight.double().T + self.offset).float()

    def whiten(self, x: Tensor, mean: Tensor) -> Tensor:
        """y (..., w) of the first w entries x (..., w), w <= D."""
        w = x.shape[-1]
        away = (x - mean[..., :w]).unsqueeze(-1)
        return torch.linalg.solve_triangular(self.factor[:w, :w], away, upper=False).squeeze(-1)

    def colour(self, y: Tensor, mean: Tensor) -> Tensor:
        """Inverse of `whiten`."""
        w = y.shape[-1]
        return mean[..., :w] + y @ self.factor[:w, :w].T

    def log_scale(self, width: int) -> Tensor:
        """log |dx / dy| of the first `width` entries."""
        return self.factor.diagonal()[:width].log().sum()
