"""Out of memory, on a GPU or a processor, as an error that says what would need less."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from nfc_gym.core.errors import InputError


@contextmanager
def enough_memory(said: str) -> Iterator[None]:
    """Where memory ends inside, an `InputError` that says so; every other error passes.

    Args:
      said: what there was no memory for, and what to do.
    """
    try:
        yield
    except (MemoryError, torch.OutOfMemoryError) as e:
        raise InputError(said) from e
    except RuntimeError as e:
        if "DefaultCPUAllocator" not in str(e):  # torch has no class for a processor's memory
            raise
        raise InputError(said) from e
