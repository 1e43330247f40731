"""The pool of terrains that a rough environment's episodes draw from: each map is made once, when first asked for."""

from functools import lru_cache
from typing import Any

from nfc_gym import terrain
from nfc_gym.core.errors import InputError

_KEPT = 512  # maps of 256 KB


def check(size: Any, seed: Any, difficulty: Any, kind: Any) -> None:
    """Raise `InputError` where the arguments describe no pool of maps."""
    if not isinstance(size, int) or size < 1:
        raise InputError(f"terrain_pool is {size!r}, want a number of maps, 1 or more")
    if not isinstance(seed, int) or seed < 0:
        raise InputError(f"terrain_seed is {seed!r}, want a whole number, 0 or more")
    if kind not in terrain.KINDS:
        raise InputError(f"terrain_kind is {kind!r}, want one of: {', '.join(terrain.KINDS)}")
    if not isinstance(difficulty, int | float) or not 0 <= difficulty <= 1:
        raise InputError(f"difficulty is {difficulty!r}, want a number from 0 to 1")


def member(index: Any, size: int, seed: int, difficulty: float, kind: str) -> terrain.Heightfield:
    """Map `index` of a pool; an index outside it raises `InputError`."""
    if index != int(index) or not 0 <= index < size:
        raise InputError(f"terrain_id is {index!r}, want a whole number from 0 to {size - 1}")
    return _member(int(index), seed, difficulty, kind)


@lru_cache(maxsize=_KEPT)
def _member(index: int, seed: int, difficulty: float, kind: str) -> terrain.Heightfield:
    return terrain.member(index, seed, difficulty, kind)
