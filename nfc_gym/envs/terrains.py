"""The pool of terrains that a rough environment's episodes draw from: each map is made once, when first asked for."""

from dataclasses import dataclass
from functools import lru_cache
from numbers import Integral, Real
from typing import Any

import numpy as np

from nfc_gym import terrain
from nfc_gym.core.errors import InputError

_KEPT = 512  # maps of 256 KB


@dataclass(frozen=True)
class Pool:
    """Maps 0 to size - 1: those of `terrain.pool` with the same arguments, but made one by one.

    Raises:
      InputError: there is no such pool.
    """

    size: Any
    seed: Any
    difficulty: Any
    kind: Any
    scale: float = 1.0

    def __post_init__(self) -> None:
        if not _number(self.size, Integral) or self.size < 1:
            raise InputError(f"terrain_pool is {self.size!r}, want a number of maps, 1 or more")
        if not _number(self.seed, Integral) or self.seed < 0:
            raise InputError(f"terrain_seed is {self.seed!r}, want a whole number, 0 or more")
        if self.kind not in terrain.KINDS:
            raise InputError(f"terrain_kind is {self.kind!r}, want one of: {', '.join(terrain.KINDS)}")
        if not _number(self.difficulty, Real) or not 0 <= self.difficulty <= 1:
            raise InputError(f"difficulty is {self.difficulty!r}, want a number from 0 to 1")
        for name, kind in (("size", int), ("seed", int), ("difficulty", float)):  # of whatever library
            object.__setattr__(self, name, kind(getattr(self, name)))

    def draw(self, u: float) -> int:
        """Index of the map that a uniform number in [0, 1) picks."""
        return int(u * self.size)

    def map(self, index: Any) -> terrain.Heightfield:
        """One map; an index outside the pool raises `InputError`."""
        value = index.item() if isinstance(index, np.generic | np.ndarray) and np.ndim(index) == 0 else index
        whole = isinstance(value, int | float) and not isinstance(value, bool)
        if not whole or value not in range(self.size):
            raise InputError(f"terrain_id is {index!r}, want a whole number from 0 to {self.size - 1}")
        return _map(self.kind, self.difficulty, self.seed, int(value), self.scale)


def _number(value: Any, kind: type) -> bool:
    """Whether it is one of a kind; a flag is none."""
    return isinstance(value, kind) and not isinstance(value, bool)


@lru_cache(maxsize=_KEPT)
def _map(kind: str, difficulty: float, seed: int, index: int, scale: float) -> terrain.Heightfield:
    own = int(np.random.SeedSequence([seed, index]).generate_state(1)[0])
    return terrain.make(kind, difficulty, own, scale=scale)
