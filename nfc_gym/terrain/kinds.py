"""Seeded terrains of one kind each: fractal roughness, slopes, steps, stepping stones, gaps.

Each generator is a function (rng, grid, difficulty) -> heights. Random choices never depend on the difficulty, and each
amplitude grows with it, so that one seed gives one landscape that a higher difficulty makes harder.

The amplitudes are those at difficulty 1; at 0 all is flat. Legged robots with legs of about 0.5 m have been trained on
slopes up to 25 degrees, steps of 0.2 m and roughness of 0.1 m (Rudin et al. 2022, "Learning to Walk in Minutes Using
Massively Parallel Deep Reinforcement Learning", CoRL), so 1 lies at the edge of what an Ant (legs of 0.57 m) can learn
and beyond what a quadruped with hips at 0.3 m can. `Grid.scale` multiplies heights for other machines: a driven wheel
climbs a step of about a third of its radius, so with a scale of 0.3 the steps of difficulty 0.5 are a Jackal's limit
(0.03 m; wheels of 0.098 m).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# name -> (value at difficulty 1, unit, reason)
AMPLITUDES: dict[str, tuple[float, str, str]] = {
    "roughness": (0.08, "m", "standard deviation; 0.1 m is the roughness legged robots of 0.5 m are trained on"),
    "grade": (0.55, "1", "steepest slope, 29 degrees: at a friction of 0.6 a foot starts to slide at 31"),
    "riser": (0.20, "m", "step height; stairs in buildings have 0.15 to 0.20 m, two thirds of a quadruped's leg"),
    "stone_gap": (0.30, "m", "between stones; what a trot of a quadruped of 0.4 m length just bridges"),
    "stone_depth": (0.60, "m", "below the stones; deeper than any leg reaches, so that a miss is a fall"),
    "stone_lift": (0.08, "m", "stones lie up to this much higher or lower than their neighbours"),
    "gap_width": (0.80, "m", "of a trench; twice what a running quadruped of 0.4 m length jumps"),
    "gap_depth": (0.60, "m", "of a trench; as for stones"),
}
WAVELENGTHS = (0.4, 4.0)  # m, of the roughness: from a foot's size to twice a robot's length
HURST = 0.8  # self-similarity of the roughness; natural ground has 0.7 to 0.9
TREADS = (0.4, 0.6)  # m, depth of a step: at least a quadruped's length of foothold at 0.1 m a cell
FLIGHTS = (4, 8)  # steps up (or down) before a landing
LANDING = 0.8  # m, level between flights, on top of a tread
RAMPS = (1.5, 3.5)  # m, length of a slope before it turns
STONES = (0.5, 0.8)  # m, side of a stone
TRENCHES = (1.6, 3.0)  # m, from one trench to the next
TILE = 5.0  # m, patches of one kind in a mixture
BLEND = 0.75  # m, half the width of the seam between them


@dataclass(frozen=True)
class Grid:
    """Where the points of a map lie, seen from its middle.

    Attributes:
      shape: (nrow, ncol).
      resolution: m a cell.
      spawn: radius of the flat patch in the middle [m].
      scale: multiplies every height.
    """

    shape: tuple[int, int]
    resolution: float
    spawn: float
    scale: float = 1.0

    @cached_property
    def xy(self) -> tuple[Array, Array]:
        """x (1, ncol) and y (nrow, 1) from the middle [m]."""
        nrow, ncol = self.shape
        x = np.arange(ncol, dtype=np.float64) - 0.5 * (ncol - 1)
        y = np.arange(nrow, dtype=np.float64) - 0.5 * (nrow - 1)
        return x[None, :] * self.resolution, y[:, None] * self.resolution

    @cached_property
    def ring(self) -> Array:
        """Distance from the spawn patch in the maximum norm [m], (nrow, ncol): constant on squares around it."""
        x, y = self.xy
        return np.maximum(np.maximum(np.abs(x), np.abs(y)) - self.spawn, 0.0)


def amplitude(name: str, difficulty: float) -> float:
    """A row of `AMPLITUDES` at a difficulty."""
    return AMPLITUDES[name][0] * difficulty


def rough(rng: np.random.Generator, grid: Grid, difficulty: float) -> Array:
    """Fractal ground: a Gaussian field with a power-law spectrum between the two `WAVELENGTHS`."""
    noise = np.fft.rfft2(rng.standard_normal(grid.shape))
    frequency = np.hypot(
        np.fft.fftfreq(grid.shape[0], grid.resolution)[:, None], np.fft.rfftfreq(grid.shape[1], grid.resolution)[None]
    )
    short, long = WAVELENGTHS
    # The spectrum falls as f^-(H + 1), flat below the longest wavelength, and fades out at the shortest.
    gain = np.maximum(frequency, 1 / long) ** -(HURST + 1) * np.exp(-((frequency * short) ** 4))
    gain[0, 0] = 0.0
    field = np.fft.irfft2(noise * gain, s=grid.shape)
    return amplitude("roughness", difficulty) * field / field.std()


def slopes(rng: np.random.Generator, grid: Grid, difficulty: float) -> Array:
    """Square rings of ramps up and down around the spawn patch, each of its own grade."""
    count = int(grid.ring.max() / RAMPS[0]) + 2
    ends = np.concatenate([[0.0], np.cumsum(rng.uniform(*RAMPS, count))])
    signs = rng.choice([-1.0, 1.0]) * (-1.0) ** np.arange(count)
    levels = np.concatenate([[0.0], np.cumsum(signs * rng.uniform(0.6, 1.0, count) * np.diff(ends))])
    return amplitude("grade", difficulty) * np.interp(grid.ring, ends, levels)


def steps(rng: np.random.Generator, grid: Grid, difficulty: float) -> Array:
    """Square rings of stairs: flights up and down in turn with landings between."""
    edges, levels = [0.0], [0.0]
    sign, landing = rng.choice([-1.0, 1.0]), 0.0
    while edges[-1] < grid.ring.max():
        tread = rng.uniform(*TREADS)
        for _ in range(rng.integers(FLIGHTS[0], FLIGHTS[1] + 1)):
            edges.append(edges[-1] + tread + landing)
            levels.append(levels[-1] + sign)
            landing = 0.0
        sign, landing = -sign, LANDING
    # The level of a point is that of the last edge before it; the first tread is the spawn patch's own level.
    return amplitude("riser", difficulty) * np.array(levels)[np.searchsorted(edges, grid.ring, "right") - 1]


def stones(rng: np.random.Generator, grid: Grid, difficulty: float) -> Array:
    """Stepping stones in rows, each row shifted by its own amount; wider gaps, deeper between and more uneven."""
    side = rng.uniform(*STONES)
    pitch = side + AMPLITUDES["stone_gap"][0] / 2
    x, y = grid.xy
    row = np.floor(y / pitch).astype(int)
    shift = rng.uniform(0, pitch, row.max() - row.min() + 1)[row - row.min()]
    column = np.floor((x + shift) / pitch).astype(int)
    lift = rng.uniform(-1, 1, (row.max() - row.min() + 1, column.max() - column.min() + 1))
    # Distance to the nearest edge of the point's own stone's cell, in either direction.
    inside = np.minimum(_to_edge(x + shift, pitch), _to_edge(y, pitch))
    top = amplitude("stone_lift", difficulty) * lift[row - row.min(), column - column.min()]
    gap = max(amplitude("stone_gap", difficulty), 1.01 * grid.resolution)
    return np.where(inside > gap / 2, top, -amplitude("stone_depth", difficulty))


def _to_edge(position: Array, pitch: float) -> Array:
    within = np.mod(position, pitch)
    return np.minimum(within, pitch - within)


def gaps(rng: np.random.Generator, grid: Grid, difficulty: float) -> Array:
    """Square trenches around the spawn patch, each of its own width; the ground between them stays level."""
    count = int(grid.ring.max() / TRENCHES[0]) + 2
    starts = 0.6 + np.cumsum(rng.uniform(*TRENCHES, count)) - TRENCHES[0]
    widths = np.maximum(amplitude("gap_width", difficulty) * rng.uniform(0.6, 1.0, count), 1.01 * grid.resolution)
    number = np.searchsorted(starts, grid.ring, "right") - 1
    inside = (number >= 0) & (grid.ring < (starts + widths)[number])
    return np.where(inside, -amplitude("gap_depth", difficulty), 0.0)


Generator = Callable[[np.random.Generator, Grid, float], Array]
SINGLE: dict[str, Generator] = {"rough": rough, "slopes": slopes, "steps": steps, "stones": stones, "gaps": gaps}
