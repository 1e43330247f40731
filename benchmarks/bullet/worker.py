"""A process of simulations: python -m bullet.worker DESCRIPTOR, of the pipe that says what to do."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection


@contextmanager
def _unheard() -> Iterator[None]:
    """What is said on standard error, by C code too, goes nowhere."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


if __name__ == "__main__":
    with _unheard():  # PyBullet says when it was built, once a process
        import pybullet  # noqa: F401

    from .herd import serve

    serve(Connection(int(sys.argv[1])))
