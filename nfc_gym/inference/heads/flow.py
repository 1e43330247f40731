"""Neural spline flow (Durkan et al. 2019), by zuko: a stronger peer of the paper's densities."""

from typing import cast

import torch
import zuko
from torch import Tensor, nn

from nfc_gym.inference.heads.density import Explicit


class Flow(Explicit):
    """An autoregressive spline flow of one block.

    Args:
      size: d.
      features: F.
      hidden: width of its networks, and of the layer that the features pass first.
      transforms: how many.
    """

    widens = True

    def __init__(self, size: int, features: int, hidden: int = 128, transforms: int = 4) -> None:
        super().__init__((size,), features)
        self.context = nn.Sequential(nn.Linear(features, hidden), nn.GELU())
        self.flow = zuko.flows.NSF(
            size, hidden, bins=8, transforms=transforms, randperm=False, hidden_features=(hidden, hidden)
        )

    def log_prob(self, x: Tensor, features: Tensor, blocks: int | None = None) -> Tensor:
        """See `Density`."""
        with torch.autocast(x.device.type, enabled=False):
            context = self.context(features.float())[:, None].expand(-1, x.shape[1], -1)
            return self.flow(context).log_prob(x.float())

    @torch.no_grad()
    def calibrate(self, x: Tensor, features: Tensor) -> None:
        """See `Density`: the normal that the flow begins at gets the spread that the pairs have there."""
        latent = self.flow(self.context(features)).transform(x)
        cast(Tensor, self.flow.base.scale).copy_(latent.square().mean().sqrt())

    def sample(self, n: int, features: Tensor, blocks: int | None = None) -> Tensor:
        """See `Density`."""
        return self.flow(self.context(features)).sample((n,)).transpose(0, 1)
