"""Several densities as one: their mean."""

import math
from collections.abc import Callable, Sequence
from typing import cast

import torch
from torch import Tensor, nn

from nfc_gym.inference.heads.density import Explicit


class Members(Explicit):
    """The mean of densities that learn side by side, each from its own share of the features.

    What few windows leave open each member guesses for itself, and where they differ their mean is wider than any of
    them: ensembles tell more, and their intervals hold what they say (Hermans et al., A trust crisis in
    simulation-based inference?, TMLR 2022).

    Args:
      sizes: width of each block.
      features: F, the members' one after the other.
      count: how many.
      make: (sizes, features) -> one of them.
    """

    def __init__(
        self, sizes: Sequence[int], features: int, count: int, make: Callable[[Sequence[int], int], Explicit]
    ) -> None:
        super().__init__(sizes, features)
        self.members = nn.ModuleList([make(sizes, features // count) for _ in range(count)])

    def _each(self, features: Tensor) -> list[tuple[Explicit, Tensor]]:
        parts = features.chunk(len(self.members), -1)
        return list(zip(cast("list[Explicit]", list(self.members)), parts, strict=True))

    def loss(self, x: Tensor, features: Tensor) -> Tensor:
        """(B,) the mean of the members' in training, so that none leans on another; else that of their mean."""
        if not self.training:
            return super().loss(x, features)
        return torch.stack([member.loss(x, part) for member, part in self._each(features)]).mean(0)

    def log_prob(self, x: Tensor, features: Tensor, blocks: int | None = None) -> Tensor:
        """See `Density`."""
        each = torch.stack([member.log_prob(x, part, blocks) for member, part in self._each(features)])
        return each.logsumexp(0) - math.log(len(each))

    def sample(self, n: int, features: Tensor, blocks: int | None = None) -> Tensor:
        """See `Density`; as many of each member's as of any other's, as nearly as n allows, in any order."""
        counts = [len(part) for part in torch.arange(n).tensor_split(len(self.members))]
        pairs = zip(self._each(features), counts, strict=True)
        drawn = torch.cat([member.sample(k, part, blocks) for (member, part), k in pairs if k], 1)
        return drawn[:, torch.randperm(n, device=drawn.device)]
