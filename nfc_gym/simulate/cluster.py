"""Ray: how this package finds a cluster, or starts one on this machine."""

import os
from collections.abc import Generator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

from nfc_gym.core.errors import InputError, MissingExtra


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def require_ray() -> None:
    """Raises `MissingExtra` where Ray is not installed."""
    if find_spec("ray") is None:
        raise MissingExtra("a cluster needs Ray: pip install 'nfc_gym[ray]'")


@contextmanager
def connected(address: str, wanted: int = 0) -> Generator[Any, None, None]:
    """The module `ray`, connected; what was started here ends with the block.

    Args:
      address: of a running cluster, `auto` for the one that this machine belongs to, `local` to start one here.
      wanted: cores of a cluster that is started here; 0 takes this machine's.

    Raises:
      MissingExtra: Ray is not installed.
      InputError: no such cluster.
    """
    require_ray()
    import ray  # pyright: ignore[reportMissingImports]

    started = not ray.is_initialized()
    if started:
        where: dict[str, Any] = {"num_cpus": wanted or cores()} if address == "local" else {"address": address}
        try:
            ray.init(**where, include_dashboard=False, logging_level="warning", log_to_driver=False)
        except (ConnectionError, ValueError, RuntimeError) as e:
            raise InputError(f"--ray {address}: no such cluster ({e}); want its address, auto or local") from None
    try:
        yield ray
    finally:
        if started:
            ray.shutdown()
