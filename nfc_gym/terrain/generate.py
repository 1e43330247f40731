"""Terrains by name: one map, a field of obstacles, or a pool of maps."""

from numbers import Integral
from typing import Any

import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import is_number, real_array
from nfc_gym.terrain.heightfield import RESOLUTION, SHAPE, Heightfield
from nfc_gym.terrain.kinds import BLEND, SINGLE, TILE, Array, Grid
from nfc_gym.terrain.towers import towers

KINDS = (*SINGLE, "mixed", "obstacles")
SPAWN = 1.0  # m, radius of the flat patch: an Ant's span is 1.6 m, and a robot needs a step's room around it
RIM = 0.8  # m, over which the patch passes into the terrain


def make(
    kind: str,
    difficulty: float,
    seed: int,
    shape: tuple[int, int] = SHAPE,
    resolution: float = RESOLUTION,
    spawn: float = SPAWN,
    scale: float = 1.0,
) -> Heightfield:
    """A terrain around a flat patch at height 0, where robots start; the same arguments give the same bits.

    Args:
      kind: one of `KINDS`.
      difficulty: in [0, 1]; 0 is flat, and one seed's terrain only gets harder with it.
      seed: non-negative.
      shape: (nrow, ncol).
      resolution: m a cell.
      spawn: radius of the flat patch [m]; beyond it a rim of `RIM` passes smoothly into the terrain.
      scale: multiplies all heights, for robots much smaller or larger than a quadruped (see `kinds`).

    Raises:
      InputError: an argument outside the above.
    """
    if kind not in KINDS:
        raise InputError(f"no terrain is called {kind!r}; the kinds are {', '.join(KINDS)}")
    rng, grid = _prepare(difficulty, seed, shape, resolution, spawn, scale)
    if kind == "obstacles":
        return Heightfield(towers(rng, grid, difficulty), resolution)
    heights = _mixed(rng, grid, difficulty) if kind == "mixed" else SINGLE[kind](rng, grid, difficulty)
    x, y = grid.xy
    rise = np.clip((np.hypot(x, y) - spawn) / RIM, 0.0, 1.0)
    return Heightfield(scale * heights * rise * rise * (3 - 2 * rise), resolution)


def obstacles(
    difficulty: float,
    seed: int,
    shape: tuple[int, int] = SHAPE,
    resolution: float = RESOLUTION,
    spawn: float = SPAWN,
    scale: float = 1.0,
    goal: tuple[float, float] | None = None,
    corridor: float = 0.0,
) -> Heightfield:
    """A floor with pillars and towers; start and goal are free, and with `corridor` the straight way between them.

    Args:
      difficulty, seed, shape, resolution, spawn, scale: as for `make`; the free start has radius `spawn`.
      goal: world x and y [m] around which a disc of radius `spawn` stays free.
      corridor: width of the free passage from the middle to the goal [m]; 0 is none.

    Raises:
      InputError: an argument outside the above, or a corridor without a goal.
    """
    rng, grid = _prepare(difficulty, seed, shape, resolution, spawn, scale)
    place = real_array((0.0, 0.0) if goal is None else goal)
    if place is None or place.shape != (2,) or not np.isfinite(place).all():
        raise InputError(f"goal {goal!r}: want the world x and y in metres")
    if not is_number(corridor) or corridor < 0:
        raise InputError(f"corridor {corridor!r}: want a width in metres, 0 or more")
    return Heightfield(towers(rng, grid, difficulty, goal, corridor), resolution)


def pool(
    size: int,
    seed: int,
    difficulty: float | tuple[float, float],
    kind: str = "mixed",
    shape: tuple[int, int] = SHAPE,
    resolution: float = RESOLUTION,
    spawn: float = SPAWN,
    scale: float = 1.0,
) -> list[Heightfield]:
    """`size` maps of one kind; map k depends on `seed` and k alone, so a larger pool begins with the smaller one.

    Args:
      size: at least 1.
      seed: non-negative.
      difficulty: of all, or (from, to) to spread it evenly over the pool.
      kind, shape, resolution, spawn, scale: as for `make`.

    Raises:
      InputError: an argument outside the above.
    """
    if isinstance(size, bool) or not isinstance(size, Integral) or size < 1:
        raise InputError(f"size {size!r}: a pool has at least one map")
    ends = difficulty if isinstance(difficulty, tuple | list) else (difficulty, difficulty)
    if len(ends) != 2 or not all(is_number(end) and 0 <= end <= 1 for end in ends):
        raise InputError(f"difficulty {difficulty!r}: want a number from 0 (flat) to 1, or two of them")
    levels = np.linspace(*ends, size)
    seeds = [int(np.random.SeedSequence([_seed(seed), k]).generate_state(1)[0]) for k in range(size)]
    return [
        make(kind, float(level), each, shape, resolution, spawn, scale)
        for level, each in zip(levels, seeds, strict=True)
    ]


def _prepare(
    difficulty: float, seed: int, shape: tuple[int, int], resolution: float, spawn: float, scale: float
) -> tuple[np.random.Generator, Grid]:
    if not is_number(difficulty) or not 0 <= difficulty <= 1:
        raise InputError(f"difficulty {difficulty!r}: want a number from 0 (flat) to 1")
    if not _pair(shape) or not all(is_number(n) and n == int(n) and n >= 2 for n in shape):
        raise InputError(f"shape {shape!r}: want (nrow, ncol), both at least 2")
    for name, value in (("resolution", resolution), ("scale", scale)):
        if not is_number(value) or value <= 0:
            raise InputError(f"{name} {value!r}: want a number above 0")
    if not is_number(spawn) or spawn < 0:
        raise InputError(f"spawn {spawn!r}: want a radius in metres, 0 or more")
    return np.random.default_rng(_seed(seed)), Grid((int(shape[0]), int(shape[1])), resolution, spawn, scale)


def _pair(value: Any) -> bool:
    return isinstance(value, tuple | list) and len(value) == 2


def _seed(seed: int) -> int:
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise InputError(f"seed {seed!r}: want an integer, 0 or more")
    return int(seed)


def _mixed(rng: np.random.Generator, grid: Grid, difficulty: float) -> Array:
    """Tiles of single kinds with soft seams, over a little roughness everywhere.

    Tiles of slopes and steps are levelled by their median, as the other kinds lie level by themselves, so that no seam
    becomes a wall between high and low ground.
    """
    parts = zip(SINGLE.values(), rng.spawn(len(SINGLE)), strict=True)
    layers = [generate(each, grid, difficulty) for generate, each in parts]
    along, across = (_windows(n, grid.resolution) for n in grid.shape)
    rows = np.array_split(np.arange(grid.shape[0]), len(along))
    cols = np.array_split(np.arange(grid.shape[1]), len(across))
    kinds = rng.permutation(np.resize(np.arange(len(layers)), len(rows) * len(cols))).reshape(len(rows), len(cols))
    levels = np.zeros(kinds.shape)
    climbing = [list(SINGLE).index(name) for name in ("slopes", "steps")]
    for i, j in np.argwhere(np.isin(kinds, climbing)):
        levels[i, j] = np.median(layers[kinds[i, j]][np.ix_(rows[i], cols[j])])
    # Around the spawn patch every kind begins at the patch's own level.
    levels[(len(rows) - 1) // 2 : len(rows) // 2 + 1, (len(cols) - 1) // 2 : len(cols) // 2 + 1] = 0.0
    heights = 0.3 * layers[0] - along.T @ levels @ across
    for k, layer in enumerate(layers):
        heights += layer * (along.T @ (kinds == k) @ across)
    return heights


def _windows(count: int, resolution: float) -> Array:
    """(tiles, count) weights along one axis: about one within a tile, none far from it, one in sum everywhere."""
    tiles = max(1, round(count * resolution / TILE))
    seams = np.arange(1, tiles)[:, None] * count / tiles
    share = np.clip((np.arange(count) - seams) * resolution / (2 * BLEND) + 0.5, 0.0, 1.0)
    passed = np.concatenate([np.ones((1, count)), share * share * (3 - 2 * share), np.zeros((1, count))])
    return passed[:-1] - passed[1:]
