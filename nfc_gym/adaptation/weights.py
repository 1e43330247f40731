"""What tells weights, and whatever else is printed or an array, from others."""

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor, nn


def digest(*parts: Any) -> str:
    """What tells things from others: arrays by type, shape and content, anything else as it is printed."""
    sha = hashlib.sha256()
    for part in parts:
        x = part.detach().cpu().numpy() if isinstance(part, Tensor) else part
        told, content = ((x.dtype, x.shape), x.tobytes()) if isinstance(x, np.ndarray) else (x, b"")
        sha.update(repr(told).encode() + content)
    return sha.hexdigest()[:16]


def flat(tensors: Mapping[str, Tensor]) -> list[Any]:
    """Names and tensors one after the other, as `digest` takes them."""
    return [part for pair in tensors.items() for part in pair]


def of_weights(module: nn.Module) -> str:
    """Of a network's weights."""
    return digest(*flat(module.state_dict()))
