"""What encoders share: the interface, and a window's signals on comparable scales."""

from typing import cast

import torch
from torch import Tensor, nn

TINY = 1e-6  # spreads below this are a constant signal, which is left as it is
SEEN = 10.0  # spreads from the mean, beyond which signals are cut: what lies farther out looks like that


class Encoder(nn.Module):
    """From a window to features.

    `forward(states (B, H+1, s), actions (B, H, a), map (B, 128, 128) or None) -> (B, features)`, states and actions as
    logged. `fit` sees windows of the training set once, before training, and keeps what it needs in buffers.

    Attributes:
      features: how many.
      waits: whether it waits for a GPU on its way, so that no CUDA graph can hold it.
    """

    features: int
    waits: bool = False

    def fit(self, states: Tensor, actions: Tensor, elevation: Tensor | None) -> None:
        """Take scales from windows of the training set."""

    def forward(self, states: Tensor, actions: Tensor, elevation: Tensor | None = None) -> Tensor:
        """Features (B, features) of a batch of windows."""
        raise NotImplementedError


class Standard(nn.Module):
    """(x - mean) / spread along the last axis, with mean and spread of the training set; a constant stays a constant.

    Args:
      size: of the last axis.
    """

    mean: Tensor
    spread: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("spread", torch.ones(size))

    def fit(self, x: Tensor) -> None:
        """From samples (..., size)."""
        flat = x.reshape(-1, x.shape[-1]).double()
        spread = flat.std(0, correction=0)
        self.mean.copy_(flat.mean(0))
        self.spread.copy_(torch.where(spread > TINY * (1 + self.mean.abs()), spread, 1.0))

    def forward(self, x: Tensor) -> Tensor:
        """The same shape, standardised."""
        return (x - self.mean) / self.spread

    def inverse(self, x: Tensor) -> Tensor:
        """Undo `forward`."""
        return x * self.spread + self.mean


class Tamed(nn.Module):
    """asinh(x / scale), standardised: linear for sizes that are usual, logarithmic in the tails, and invertible.

    Residuals of dynamics have tails (an impact, a slip) that would otherwise set the scale of everything else.

    Args:
      size: of the last axis.
    """

    scale: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("scale", torch.ones(size))
        self.standard = Standard(size)

    def fit(self, x: Tensor) -> None:
        """From samples (n, size); the scale is the median size of those that are not zero."""
        sizes = x.abs()
        there = sizes > TINY * sizes.amax(0)
        self.scale.copy_(sizes.where(there, torch.nan).nanmedian(0).values.nan_to_num(1.0))
        self.standard.fit((x / self.scale).asinh())

    def forward(self, x: Tensor) -> Tensor:
        """The same shape."""
        return self.standard((x / self.scale).asinh())

    def inverse(self, y: Tensor) -> Tensor:
        """Undo `forward`."""
        return self.scale * self.standard.inverse(y).clamp(-20, 20).sinh()

    def log_slope(self, x: Tensor) -> Tensor:
        """log of the derivative of each entry, the shape of x."""
        return -(self.scale.log() + (x / self.scale).square().log1p() / 2 + self.standard.spread.log())


class Signals(nn.Module):
    """States, their steps and actions as one standardised series (B, H+1, 2 s + a), clipped at `SEEN` spreads.

    What psi does shows in accelerations: a step s_{t+1} - s_t is a small difference of large numbers once states are
    standardised, so it comes as a channel of its own (0 at t = 0). The action at t leads from s_t to s_{t+1}; the last
    time has none (0).

    Args:
      states: s.
      actions: a.
    """

    def __init__(self, states: int, actions: int) -> None:
        super().__init__()
        self.channels = 2 * states + actions
        sizes = {"s": states, "ds": states, "a": actions}
        self.scales = nn.ModuleDict({name: Standard(size) for name, size in sizes.items()})

    def fit(self, states: Tensor, actions: Tensor) -> None:
        """Take scales from windows of the training set."""
        parts = {"s": states, "ds": states.diff(dim=1), "a": actions}
        for name, x in parts.items():
            if x.numel():
                cast(Standard, self.scales[name]).fit(x)

    def forward(self, states: Tensor, actions: Tensor) -> Tensor:
        """(B, H+1, channels)."""
        steps = nn.functional.pad(self.scales["ds"](states.diff(dim=1)), (0, 0, 1, 0))
        actions = nn.functional.pad(self.scales["a"](actions), (0, 0, 0, 1))
        return torch.cat([self.scales["s"](states), steps, actions], -1).clamp(-SEEN, SEEN)

    def far(self, states: Tensor) -> Tensor:
        """(s,) spreads that the median of each state of one window (H+1, s) lies from the training set's mean."""
        return self.scales["s"](states).median(0).values.abs()


class SignalEncoder(Encoder):
    """An encoder of the series of `Signals`: a subclass writes `embed`.

    Args:
      horizon: H.
      states: s.
      actions: a.
    """

    def __init__(self, horizon: int, states: int, actions: int) -> None:
        super().__init__()
        self.signals = Signals(states, actions)
        self.channels = self.signals.channels
        self.length = horizon + 1

    def fit(self, states: Tensor, actions: Tensor, elevation: Tensor | None) -> None:
        """Take scales from windows of the training set."""
        self.signals.fit(states, actions)

    def forward(self, states: Tensor, actions: Tensor, elevation: Tensor | None = None) -> Tensor:
        """Features of the motion alone."""
        return self.embed(self.signals(states, actions))

    def embed(self, x: Tensor) -> Tensor:
        """(B, H+1, channels) -> (B, features)."""
        raise NotImplementedError
