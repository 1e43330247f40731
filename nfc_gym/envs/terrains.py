"""The pool of terrains that a rough environment's episodes draw from: made once, and kept for the whole process."""

from functools import cache

from nfc_gym import terrain
from nfc_gym.core.errors import InputError


@cache
def pool(size: int, seed: int, difficulty: float, kind: str) -> tuple[terrain.Heightfield, ...]:
    """`size` maps; the same arguments give the same maps.

    Raises:
      InputError: a size below one, an unknown kind, a difficulty outside [0, 1].
    """
    if not isinstance(size, int) or size < 1:
        raise InputError(f"terrain_pool is {size!r}, want a number of maps, 1 or more")
    return tuple(terrain.pool(size, seed, difficulty, kind))
