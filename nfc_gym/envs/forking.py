"""Batches across `fork`: a child process has none of the threads that a batch waits for when it is freed.

Without this, a worker that is forked while a vector environment is alive, as `AsyncVectorEnv` and data loaders fork
theirs, hangs or aborts as soon as its garbage collector meets the copy of that environment.
"""

import ctypes
import os
from weakref import WeakSet

from mujoco.batch import Batch

from nfc_gym.core.errors import InputError

_batches: WeakSet[Batch] = WeakSet()
_stranded: WeakSet[Batch] = WeakSet()  # in a child process, without the threads that they step with


def safe_to_fork(batch: Batch) -> Batch:
    """The batch, which child processes forked from now on will never free."""
    _batches.add(batch)
    return batch


def require_threads(batch: Batch) -> None:
    """Refuse to step a batch of another process, which would wait for ever.

    Raises:
      InputError: it steps with several threads, and was made before this process was forked.
    """
    if batch in _stranded:
        raise InputError(
            "this vector environment was made before its process was forked, and its threads stayed behind: make one "
            "with gymnasium.make_vec in the process that steps it, or give nthread=1"
        )


def _keep() -> None:
    for batch in list(_batches):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(batch))
        if batch.nthread != 1:
            _stranded.add(batch)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_keep)
