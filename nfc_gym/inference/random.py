"""Draws of torch's libraries that depend on a seed alone and leave the caller's generators as they were."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch


@contextmanager
def seeded(seed: int | np.random.Generator) -> Iterator[None]:
    """Torch's generators start from `seed` (or from a draw of a numpy generator) inside, and are restored after."""
    if isinstance(seed, np.random.Generator):
        seed = int(seed.integers(2**63))
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        yield


def mixed(seed: int, *at: int) -> int:
    """One seed from several integers, such that neighbours share nothing."""
    return int(np.random.SeedSequence((seed, *at)).generate_state(1, np.uint64)[0] >> 1)
