"""A conditional U-Net over maps of heights (Ronneberger et al. 2015), for the score of delta_e."""

import torch
from torch import Tensor, nn

CHANNELS = (32, 64, 128, 128)  # at 64, 32, 16 and 8 cells a side
_PATCH = 2  # cells a side that become channels before the first convolution: a quarter of the work, nothing lost


class Conditioned(nn.Module):
    """Two 3 x 3 convolutions beside a residual path; the condition scales and shifts between them."""

    def __init__(self, inside: int, outside: int, condition: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList([nn.GroupNorm(8, c) for c in (inside, outside)])
        self.convs = nn.ModuleList([nn.Conv2d(c, outside, 3, padding=1) for c in (inside, outside)])
        self.modulate = nn.Linear(condition, 2 * outside)
        self.short = nn.Conv2d(inside, outside, 1) if inside != outside else nn.Identity()

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """(B, inside, h, w) and (B, condition) -> (B, outside, h, w)."""
        y = self.convs[0](nn.functional.silu(self.norms[0](x)))
        scale, shift = self.modulate(condition)[..., None, None].chunk(2, 1)
        y = self.convs[1](nn.functional.silu(self.norms[1](y) * (1 + scale) + shift))
        return self.short(x) + y


class UNet(nn.Module):
    """Maps in, one map out: a network's, plus a weight of each map that the condition sets; all of it starts at 0.

    The weights are the linear answer for cells that know nothing of each other, which convolutions of normalised
    channels are slow to find.

    Args:
      maps: how many go in.
      condition: width of the vector that modulates every block.

    Attributes:
      summary: channels of its coarsest level.
    """

    summary = CHANNELS[-1]

    def __init__(self, maps: int, condition: int) -> None:
        super().__init__()
        first, *others = CHANNELS
        self.enter = nn.Conv2d(maps * _PATCH**2, first, 3, padding=1)
        self.down = nn.ModuleList([Conditioned(c, c, condition) for c in CHANNELS[:-1]])
        self.shrink = nn.ModuleList([nn.Conv2d(a, b, 3, 2, 1) for a, b in zip(CHANNELS, others, strict=False)])
        self.middle = Conditioned(CHANNELS[-1], CHANNELS[-1], condition)
        pairs = list(zip(CHANNELS[:-1], others, strict=True))[::-1]
        self.grow = nn.ModuleList([nn.Conv2d(b, a, 1) for a, b in pairs])
        self.up = nn.ModuleList([Conditioned(2 * a, a, condition) for a, _ in pairs])
        last = nn.Conv2d(first, _PATCH**2, 3, padding=1)
        self.leave = nn.Sequential(nn.GroupNorm(8, first), nn.SiLU(), last)
        self.weights = nn.Linear(condition, maps)
        for layer in (last, self.weights):
            nn.init.zeros_(layer.weight)
            assert layer.bias is not None
            nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor, condition: Tensor) -> tuple[Tensor, Tensor]:
        """(B, maps, 128, 128) and (B, condition) -> a map (B, 128, 128), and (B, summary) of the coarsest level."""
        linear = (self.weights(condition)[..., None, None] * x).sum(1)
        x = self.enter(nn.functional.pixel_unshuffle(x, _PATCH))
        kept: list[Tensor] = []
        for block, shrink in zip(self.down, self.shrink, strict=True):
            x = block(x, condition)
            kept.append(x)
            x = shrink(x)
        x = self.middle(x, condition)
        summary = x.mean((-2, -1))
        for grow, block in zip(self.grow, self.up, strict=True):
            x = nn.functional.interpolate(grow(x), scale_factor=2.0)
            x = block(torch.cat([x, kept.pop()], 1), condition)
        return nn.functional.pixel_shuffle(self.leave(x), _PATCH)[:, 0] + linear, summary
