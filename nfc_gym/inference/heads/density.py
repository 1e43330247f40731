"""What a conditional density offers, and the chain that makes a joint density of several blocks."""

from collections.abc import Callable, Sequence
from typing import cast

import torch
from torch import Tensor, nn


class Density(nn.Module):
    """A density of x given features. x is psi's z, then the standardised delta_s: `sizes` are the blocks' widths.

    x has shape (B, n, D): n points for each of B windows, whose features are (B, F). What is asked of the first
    `blocks` blocks alone takes and gives points of their width, and is exact for them.

    Args:
      sizes: width of each block.
      features: F.

    Attributes:
      widens: whether `calibrate` has something to set.
      drawing: names of what `sample` takes beside.
      judging: names of what `log_prob` takes beside.
    """

    widens = False
    drawing: tuple[str, ...] = ()
    judging: tuple[str, ...] = ()

    def __init__(self, sizes: Sequence[int], features: int) -> None:
        super().__init__()
        self.sizes = tuple(sizes)
        self.inputs = features

    def width(self, blocks: int | None) -> int:
        """Width of the first `blocks` blocks, default all."""
        return sum(self.sizes[:blocks])

    def loss(self, x: Tensor, features: Tensor) -> Tensor:
        """(B,) what training brings down, averaged over the n points."""
        raise NotImplementedError

    def sample(self, n: int, features: Tensor, blocks: int | None = None) -> Tensor:
        """(B, n, width) draws."""
        raise NotImplementedError

    def log_prob(self, x: Tensor, features: Tensor, blocks: int | None = None) -> Tensor:
        """(B, n) log density of x (B, n, width), nats."""
        raise NotImplementedError

    def calibrate(self, x: Tensor, features: Tensor) -> None:
        """Take the width from pairs x (B, D) and features (B, F) that were not trained on, where it `widens`.

        What is learned from few windows is too sure of itself; how much so, windows that were held out tell.
        """


class Explicit(Density):
    """A density that is evaluated in one pass, and so trained on its log-likelihood."""

    def loss(self, x: Tensor, features: Tensor) -> Tensor:
        """(B,) negative log density."""
        return -self.log_prob(x, features).mean(1)


class Chain(Explicit):
    """q(x_1 | f) q(x_2 | f, x_1) ...: one density a block, each given the blocks before it.

    delta_s is defined relative to psi, and the first factor alone is the density of psi.

    Args:
      sizes: width of each block.
      features: F.
      make: (width, features) -> a density of one block.
    """

    def __init__(self, sizes: Sequence[int], features: int, make: Callable[[int, int], Density]) -> None:
        super().__init__(sizes, features)
        before = [sum(sizes[:i]) for i in range(len(sizes))]
        self.links = nn.ModuleList([make(size, features + b) for size, b in zip(sizes, before, strict=True)])
        self.widens = any(cast(Density, link).widens for link in self.links)

    def log_prob(self, x: Tensor, features: Tensor, blocks: int | None = None) -> Tensor:
        """See `Density`."""
        b, n, _ = x.shape
        rows, at = x.flatten(0, 1)[:, None], 0
        given = features[:, None].expand(b, n, -1).flatten(0, 1)
        total = x.new_zeros(b * n, 1)
        for link, size in zip(self.links[:blocks], self.sizes, strict=False):
            total = total + cast(Density, link).log_prob(
                rows[..., at : at + size], torch.cat([given, rows[:, 0, :at]], 1)
            )
            at += size
        return total.view(b, n)

    def calibrate(self, x: Tensor, features: Tensor) -> None:
        """Each link's, given the blocks before it."""
        at = 0
        for link, size in zip(self.links, self.sizes, strict=True):
            cast(Density, link).calibrate(x[:, at : at + size], torch.cat([features, x[:, :at]], 1))
            at += size

    def sample(self, n: int, features: Tensor, blocks: int | None = None) -> Tensor:
        """See `Density`."""
        first, *others = cast("list[Density]", list(self.links[:blocks]))
        x = first.sample(n, features)
        given = features[:, None].expand(-1, n, -1).flatten(0, 1)
        for link in others:
            known = torch.cat([given, x.flatten(0, 1)], 1)
            x = torch.cat([x, link.sample(1, known).view(*x.shape[:2], -1)], -1)
        return x
