"""Batches and graphics across `fork`: a child process has none of the threads that they wait for.

Without this, a worker that is forked while a vector environment is alive, as `AsyncVectorEnv` and data loaders fork
theirs, hangs or aborts as soon as its garbage collector meets the copy of that environment. And a worker that is forked
once pictures were drawn hangs as soon as it draws one itself.
"""

import ctypes
import os
import sys
from weakref import WeakSet

from mujoco.batch import Batch

from nfc_gym.core.errors import InputError

_batches: WeakSet[Batch] = WeakSet()
_stranded: WeakSet[Batch] = WeakSet()  # in a child process, without the threads that they step with
_drew = False  # a graphics library was loaded, in this process or in one that it was forked from
_cut_off = False  # from that library, which works in the process that loaded it alone


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


def require_graphics() -> None:
    """Note that this process draws, or refuse to: it would wait for ever.

    Raises:
      InputError: it was forked from a process that had drawn.
    """
    global _drew
    if _cut_off:
        raise InputError(
            "this process was forked from one that had drawn pictures, and can draw none: start workers before the "
            'first picture, or by spawn, as in gymnasium.make_vec(..., vectorization_mode="async", '
            'vector_kwargs={"context": "spawn"})'
        )
    _drew = True


def _cut() -> None:
    global _cut_off
    egl = sys.modules.get("mujoco.egl")  # by which others draw too: Gymnasium's environments, `mujoco.Renderer`
    _cut_off = _cut_off or _drew or getattr(egl, "EGL_DISPLAY", None) is not None


def _keep() -> None:
    for batch in list(_batches):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(batch))
        if batch.nthread != 1:
            _stranded.add(batch)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_keep)
    os.register_at_fork(after_in_child=_cut)
