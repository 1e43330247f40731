"""Five kinds of disturbance that a stretch of signals is given to train on, since real anomalies are scarce.

Global, Contextual, Seasonal, Shapelet and Trend are the kinds of Darban, Webb, Pan, Aggarwal and Salehi (2025), "CARLA:
self-supervised contrastive representation learning for time series anomaly detection", which the paper names. Each is
added to the signals in units of every channel's own spread; sign, size, stretch and channels are drawn for each window.
Every one changes something by `LEAST` spreads or more, so that no window is called anomalous that is not.
"""

from typing import NamedTuple

import torch
from torch import Tensor

KINDS = ("global", "contextual", "seasonal", "shapelet", "trend")
LEAST = 0.5  # spreads: the smallest change that an injection makes at its largest


class _Stretch(NamedTuple):
    """Where windows are disturbed: `within` (B, T, 1) flags, `phase` (B, T, 1) from 0 to 1, `first` (B, 1, 1)."""

    within: Tensor
    phase: Tensor
    first: Tensor


def injected(x: Tensor, spread: Tensor, kind: Tensor) -> Tensor:
    """Signals with one disturbance each; randomness is torch's own.

    Args:
      x: (B, T, c) signals, T 4 or more.
      spread: (c,) of each channel over the training set; a channel of spread 0 is constant and is left alone.
      kind: (B,) indices into `KINDS`.

    Returns:
      (B, T, c).
    """
    at = _stretch(x)
    added = torch.stack([
        _points(x) * _size(x, 3.0, 8.0) * spread,
        _points(x) * _size(x, 2.0, 4.0) * torch.maximum(x.std(1, keepdim=True), LEAST / 2 * spread),
        at.within * torch.cos(2 * torch.pi * at.phase * _uniform(x, 2.0, 6.0)) * _size(x, LEAST, 2.0) * spread,
        _another_shape(x, spread, at),
        at.phase * _size(x, LEAST, 3.0) * spread,
    ])  # fmt: skip
    return x + _channels(x, spread) * added[kind, torch.arange(len(x), device=x.device)]


def _stretch(x: Tensor) -> _Stretch:
    """A quarter to three quarters of each window, anywhere in it; its phase stays 1 afterwards."""
    b, t, _ = x.shape
    length = torch.randint(max(2, t // 4), max(3, 3 * t // 4 + 1), (b, 1, 1), device=x.device)
    first = (torch.rand(b, 1, 1, device=x.device) * (t - length + 1)).long()
    time = torch.arange(t, device=x.device)[None, :, None]
    within = (time >= first) & (time < first + length)
    return _Stretch(within, ((time - first) / (length - 1)).clamp(0, 1), first)


def _another_shape(x: Tensor, spread: Tensor, at: _Stretch) -> Tensor:
    """What makes the stretch flat, at an offset from the value that it begins with."""
    held = x.gather(1, at.first.expand(-1, -1, x.shape[2]))
    return at.within * (held + _size(x, LEAST, 2.0) * spread - x)


def _uniform(x: Tensor, low: float, high: float) -> Tensor:
    """(B, 1, 1)."""
    return low + (high - low) * torch.rand(len(x), 1, 1, device=x.device, dtype=x.dtype)


def _size(x: Tensor, low: float, high: float) -> Tensor:
    """(B, 1, 1) uniform in the logarithm, of either sign."""
    sign = 2 * torch.randint(2, (len(x), 1, 1), device=x.device) - 1
    return sign * low * (high / low) ** _uniform(x, 0.0, 1.0)


def _points(x: Tensor) -> Tensor:
    """(B, T, 1) 1 at one to three times, 0 elsewhere."""
    b, t, _ = x.shape
    rank = torch.rand(b, t, device=x.device).argsort(1).argsort(1)
    return (rank < torch.randint(1, 4, (b, 1), device=x.device)).to(x.dtype)[..., None]


def _channels(x: Tensor, spread: Tensor) -> Tensor:
    """(B, 1, c) 1 for the channels that are disturbed: a random share of those that vary, one at least."""
    varies = spread > 0
    rank = torch.where(varies, torch.rand(len(x), len(spread), device=x.device), -1.0)
    chosen = rank > torch.rand(len(x), 1, device=x.device)
    return (chosen.scatter(1, rank.argmax(1, keepdim=True), True) & varies).to(x.dtype)[:, None]
