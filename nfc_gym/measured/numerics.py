"""What the last bits of a result depend on besides its inputs, and how they are kept from doing so."""

import hashlib
from contextlib import AbstractContextManager

import mujoco
import numpy as np
from threadpoolctl import threadpool_limits


def one_blas_thread() -> AbstractContextManager:
    """Linear algebra on one thread while the context lasts.

    BLAS cuts sums in pieces by the number of its threads, and sums cut otherwise round otherwise: the same seed would
    give other last bits on another machine's cores. Threads go to the roll-outs, whose rows never meet.
    """
    return threadpool_limits(1, "blas")


def fingerprint(model: mujoco.MjModel) -> str:
    """SHA-256 of every array of a compiled model: what its file includes and which meshes it reads shows here."""
    sha = hashlib.sha256()
    for owner in (model, model.opt):
        for name in sorted(n for n in dir(owner) if not n.startswith("_")):
            value = getattr(owner, name)
            if isinstance(value, np.ndarray | np.generic | int | float):
                sha.update(name.encode() + np.asarray(value).tobytes())
    return sha.hexdigest()
