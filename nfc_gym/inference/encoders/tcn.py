"""Causal temporal convolutions: what the paper encodes windows with."""

from typing import Any, cast

import torch
from torch import Tensor, nn

from nfc_gym.inference.encoders.base import SignalEncoder

CHANNELS = (256, 128, 64, 16)  # paper, appendix "Network Architecture"


class Reached(torch.autograd.Function):
    """What a causal convolution sees at each time, side by side: x (B, T, c) -> (B, T, k c), 0 before the beginning.

    The k times lie `dilation` apart and end with the present one. The derivative is torch's own, which would fill and
    add an array as large as x for each of them: an eighth of a training step on a GPU.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, width: int, dilation: int) -> Tensor:
        """See above; k is `width`."""
        ctx.width, ctx.dilation = width, dilation
        past = nn.functional.pad(x, (0, 0, (width - 1) * dilation, 0))
        return torch.cat([past[:, k * dilation : k * dilation + x.shape[1]] for k in range(width)], -1)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        """Each time's slopes, gathered from the times that saw it."""
        *early, now = slope.chunk(ctx.width, -1)
        found, length = now.clone(memory_format=torch.contiguous_format), slope.shape[1]
        for k, part in enumerate(early):
            away = (ctx.width - 1 - k) * ctx.dilation
            if away < length:
                found[:, : length - away] += part[:, away:]
        return found, None, None


class CausalBlock(nn.Module):
    """Two causal convolutions of one dilation beside a residual path (Bai, Kolter and Koltun 2018, section 3).

    Each is preceded by a normalisation over the channels of one time, which keeps the block causal. A convolution is
    one matrix product, of the times that it reaches laid side by side: dilated convolutions of short series are slow
    on a GPU, and their layout is not the normalisation's.
    """

    def __init__(self, inside: int, outside: int, dilation: int, width: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList([nn.LayerNorm(inside), nn.LayerNorm(outside)])
        self.convs = nn.ModuleList([nn.Conv1d(c, outside, width, dilation=dilation) for c in (inside, outside)])
        self.short = nn.Conv1d(inside, outside, 1) if inside != outside else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """(B, T, inside) -> (B, T, outside); time t sees times up to t."""
        y = x
        for norm, conv in zip(self.norms, map(_conv, self.convs), strict=True):
            y = cast(Tensor, Reached.apply(norm(y), conv.kernel_size[0], conv.dilation[0]))
            y = nn.functional.gelu(nn.functional.linear(y, conv.weight.mT.flatten(1), conv.bias))
        return y + (x if isinstance(self.short, nn.Identity) else _pointwise(_conv(self.short), x))


def _conv(module: nn.Module) -> nn.Conv1d:
    return cast(nn.Conv1d, module)


def _pointwise(conv: nn.Conv1d, x: Tensor) -> Tensor:
    """A convolution over one time, channels last."""
    return nn.functional.linear(x, conv.weight[..., 0], conv.bias)


class TCN(SignalEncoder):
    """Channels [256, 128, 64, 16], dilations 1, 2, 4, 8, flattened over time.

    The last time alone would be 16 numbers, fewer than most robots have parameters. With kernels of 3, the last time
    sees 61 steps back: every window of the paper.

    Args:
      horizon: H.
      states: s.
      actions: a.
      width: of the kernels.
    """

    def __init__(self, horizon: int, states: int, actions: int, width: int = 3) -> None:
        super().__init__(horizon, states, actions)
        sizes = (CHANNELS[0], *CHANNELS)
        self.first = nn.Conv1d(self.channels, CHANNELS[0], 1)
        self.blocks = nn.Sequential(
            *(CausalBlock(a, b, 2**i, width) for i, (a, b) in enumerate(zip(sizes, CHANNELS, strict=False)))
        )
        self.features = CHANNELS[-1] * self.length

    def embed(self, x: Tensor) -> Tensor:
        """(B, H+1, channels) -> (B, 16 (H+1))."""
        return self.blocks(_pointwise(self.first, x)).mT.flatten(1)
