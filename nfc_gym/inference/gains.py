"""What windows tell of the psi that made them, by a network's density of it."""

import numpy as np
import torch
from numpy.typing import NDArray

from nfc_gym.inference.data import Batch
from nfc_gym.inference.network import Network
from nfc_gym.inference.space import EDGE

Array = NDArray[np.float64]


@torch.no_grad()
def gains(network: Network, batch: Batch) -> Array:
    """(B,) log density at each window's own psi over the prior's, nats a free parameter; 0 tells nothing.

    Args:
      network: trained; it is put to evaluation.
      batch: windows that it did not learn from.
    """
    network.eval()
    own = {k: t.to(network.free.device) for k, t in batch.items()}
    z = torch.special.ndtri(own["psi"][:, network.free].clamp(EDGE, 1 - EDGE))
    given = network.encode(own["states"], own["actions"], own["map"] if network.config.elevation else None)
    prior = -(z**2 + np.log(2 * np.pi)).sum(1) / 2
    return ((network.log_prob(z[:, None], given, 1)[:, 0] - prior) / max(1, z.shape[1])).double().cpu().numpy()
