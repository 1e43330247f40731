"""Draws of torch's libraries that depend on a seed alone and leave the caller's generators as they were."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

_one = threading.RLock()  # these generators are the process's: two threads at once would take each other's numbers


@contextmanager
def seeded(seed: int | np.random.Generator, device: torch.device | None = None) -> Iterator[None]:
    """Torch's generators start from `seed` (or from a draw of a numpy generator) inside, and are restored after.

    Threads wait for one another.

    Args:
      seed: or a generator to draw one from.
      device: where numbers are drawn, beside the processor; None for all GPUs, each of which takes its time.
    """
    if isinstance(seed, np.random.Generator):
        seed = int(seed.integers(2**63))
    if device is None:
        gpus = list(range(torch.cuda.device_count()))
    else:
        gpus = [torch.cuda.current_device() if device.index is None else device.index] if device.type == "cuda" else []
    with _one, torch.random.fork_rng(gpus):
        torch.default_generator.manual_seed(seed)
        for gpu in gpus:
            torch.cuda.default_generators[gpu].manual_seed(seed)
        yield


def mixed(seed: int, *at: int) -> int:
    """One seed from several integers, such that neighbours share nothing."""
    return int(np.random.SeedSequence((seed, *at)).generate_state(1, np.uint64)[0] >> 1)
