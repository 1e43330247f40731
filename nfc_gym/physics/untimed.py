"""MuJoCo's stopwatches, halted while nobody reads them."""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco


@contextmanager
def untimed() -> Iterator[None]:
    """No physics step measures its own parts (`MjData.timer`) while the context lasts.

    Each step asks the clock some thirty times, about a microsecond in all: a tenth of a wheeled robot's step.
    """
    try:
        # The Python package sets the clock to a C function, which its own setter cannot put back.
        clock = ctypes.c_void_p.in_dll(ctypes.CDLL(mujoco._callbacks.__file__), "mjcb_time")
    except (OSError, ValueError):  # linked otherwise: steps then take a little longer
        yield
        return
    kept, clock.value = clock.value, None
    try:
        yield
    finally:
        clock.value = kept
