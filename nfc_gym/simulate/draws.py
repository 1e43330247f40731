"""Where chance comes from: each shard, window and attempt has a seed sequence of its own, whoever computes it."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# What a seed is for: the third number of its key.
LABELS, MOTION, GROUND, PLACES, PROPOSAL, MOTOR = range(6)


def generator(seed: int, shard: int, purpose: int, row: int = 0, attempt: int = 0) -> np.random.Generator:
    """The generator of one purpose."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(shard, purpose, row, attempt)))


def uniforms(seed: int, shard: int, purpose: int, rows: NDArray[np.integer], attempt: int, count: int) -> Array:
    """(n, count) uniform numbers in [0, 1), each row of its window's own generator."""
    out = np.empty((len(rows), count))
    for i, row in enumerate(rows):
        out[i] = generator(seed, shard, purpose, int(row), attempt).random(count)
    return out


def normals(
    seed: int, shard: int, purpose: int, rows: NDArray[np.integer], attempt: int, shape: tuple[int, ...]
) -> Array:
    """(n, *shape) standard normal numbers, each row of its window's own generator."""
    out = np.empty((len(rows), *shape))
    for i, row in enumerate(rows):
        out[i] = generator(seed, shard, purpose, int(row), attempt).standard_normal(shape)
    return out


def between(u: Array, low: float, high: float) -> Array:
    """Uniform numbers to [low, high)."""
    return low + (high - low) * u


def geometric(u: Array, low: float, high: float) -> Array:
    """Uniform numbers to [low, high), uniformly in the logarithm."""
    return low * (high / low) ** u


def picked(u: Array, count: int) -> NDArray[np.intp]:
    """Uniform numbers to 0, ..., count - 1."""
    return (u * count).astype(np.intp)
