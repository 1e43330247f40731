"""Batches across `fork`: a child process has none of the threads that a batch waits for when it is freed.

Without this, a worker that is forked while a vector environment is alive, as `AsyncVectorEnv` and data loaders fork
theirs, hangs or aborts as soon as its garbage collector meets the copy of that environment.
"""

import ctypes
import os
from weakref import WeakSet

from mujoco.batch import Batch

_batches: WeakSet[Batch] = WeakSet()


def safe_to_fork(batch: Batch) -> Batch:
    """The batch, which child processes forked from now on will never free."""
    _batches.add(batch)
    return batch


def _keep() -> None:
    for batch in list(_batches):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(batch))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_keep)
