"""Causal temporal convolutions: what the paper encodes windows with."""

from torch import Tensor, nn

from nfc_gym.inference.encoders.base import SignalEncoder

CHANNELS = (256, 128, 64, 16)  # paper, appendix "Network Architecture"


class CausalBlock(nn.Module):
    """Two causal convolutions of one dilation beside a residual path (Bai, Kolter and Koltun 2018, section 3).

    Each is preceded by a normalisation over the channels of one time, which keeps the block causal.
    """

    def __init__(self, inside: int, outside: int, dilation: int, width: int) -> None:
        super().__init__()
        self.reach = (width - 1) * dilation
        self.norms = nn.ModuleList([nn.LayerNorm(inside), nn.LayerNorm(outside)])
        self.convs = nn.ModuleList([nn.Conv1d(c, outside, width, dilation=dilation) for c in (inside, outside)])
        self.short = nn.Conv1d(inside, outside, 1) if inside != outside else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """(B, inside, T) -> (B, outside, T); time t sees times up to t."""
        y = x
        for norm, conv in zip(self.norms, self.convs, strict=True):
            y = norm(y.mT).mT
            y = nn.functional.gelu(conv(nn.functional.pad(y, (self.reach, 0))))
        return self.short(x) + y


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
        return self.blocks(self.first(x.mT)).flatten(1)
