"""What many windows of one machine say together of the family of effects that it has: the structure head's evidence.

A window w tells of a family f by p(f | w) / p(f), its posterior over the share of f in the training set. Independent
windows would multiply,

    log p(f | all) = log p(f) + T sum_w log(p(f | w) / p(f)) + const,

with T = 1. Windows of one machine are not independent evidence for a network: what it gets wrong in one (another
controller's motion, a sensor's delay) it gets wrong in all. The sum is therefore tempered to that of at most
`EFFECTIVE` windows, and each window is taken to be unlike anything in the training set with probability `STRAY`, so
that none can exclude a family by itself.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.inference.network import Network

Array = NDArray[np.float64]
EFFECTIVE = 8.0  # windows that any number of them counts for at most
STRAY = 0.05
_ROWS = 1024  # windows at once


def combined(told: Array, shares: Array) -> Array:
    """(f,) probabilities of the families from what each window told.

    Args:
      told: (W, f) probabilities given each window.
      shares: (f,) of the families in the training set; one that is 0 there stays 0.

    Raises:
      InputError: no window, or other numbers of families.
    """
    if told.ndim != 2 or not len(told) or told.shape[1:] != shares.shape:
        raise InputError(f"evidence: want (windows, {len(shares)}) probabilities, one window or more, got {told.shape}")
    known = shares > 0
    prior = shares[known] / shares[known].sum()
    each = (1 - STRAY) * told[:, known] + STRAY * prior
    score = np.log(prior) + min(1.0, EFFECTIVE / len(told)) * np.log(each / prior).sum(0)
    out = np.zeros(len(shares))
    out[known] = np.exp(score - score.max())
    return out / out.sum()


@torch.no_grad()
def told_by(network: Network, states: Array, actions: Array) -> Array:
    """(W, f) probabilities of the families given each of W windows.

    Args:
      network: with a structure head.
      states, actions: (W, H+1, s) and (W, H, a), as it was trained on.

    Raises:
      InputError: a network without a structure head, or windows of another shape than it was trained on.
    """
    size = network.sizes
    if network.structure is None:
        raise InputError("this network was trained without a structure head: `nfc-gym train --structure`")
    for name, x, shape in (
        ("states", states, (size.horizon + 1, size.states)),
        ("actions", actions, (size.horizon, size.actions)),
    ):
        if x.ndim != 3 or x.shape[1:] != shape or not np.isfinite(x).all():
            raise InputError(
                f"windows: {name} must be finite, of shape (windows, {shape[0]}, {shape[1]}), got {x.shape}"
            )
    out = []
    for at in range(0, len(states), _ROWS):
        pair = (torch.as_tensor(x[at : at + _ROWS], dtype=torch.float32) for x in (states, actions))
        out.append(network.structure(network.encode(*pair).features).double().cpu().numpy())
    return np.concatenate(out) if out else np.zeros((0, len(network.config.families)))


def shares_of(families: Sequence[str], notes: dict) -> Array:
    """(f,) share of each family in the training set, from a checkpoint's notes; half none where it does not say."""
    even = np.full(len(families), 0.5 / max(len(families) - 1, 1))
    even[0] = 0.5
    kept = np.asarray(notes.get("shares", even), float)
    return kept if kept.shape == even.shape else even
