"""MuJoCo's warnings, kept to itself: of simulations that come apart and are counted, of models compiled repeatedly."""

import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import mujoco

_lock = threading.Lock()
_inside = 0  # how many contexts last, of all threads
_handler: Callable[[str], None] | None = None  # what was there before the first of them


@contextmanager
def no_warnings() -> Iterator[None]:
    """MuJoCo neither prints its warnings nor writes them to `MUJOCO_LOG.TXT` while the context lasts.

    The handler is one of the whole process. The last of the contexts to end, of whatever thread, gives back the one
    that was there before the first. Also a decorator.
    """
    global _inside, _handler
    with _lock:
        if not _inside:
            _handler = mujoco.get_mju_user_warning()
            mujoco.set_mju_user_warning(lambda message: None)
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if not _inside:
                mujoco.set_mju_user_warning(_handler)


def compiled(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, list[str]]:
    """A model, and what MuJoCo remarked as it compiled it, each once: of old attributes, say, it warns every time.

    Raises:
      ValueError: it does not compile.
    """
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        model = spec.compile()
    return model, list(dict.fromkeys(str(w.message) for w in said))
