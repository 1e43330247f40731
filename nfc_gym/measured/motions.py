"""Families of motion, and what a search may vary: command sequences in units of each actuator's room, from -1 to 1.

0 is the resting command; -1 and 1 are its bounds. Fourier series with bounded amplitude are what Swevers, Ganseman,
Tukel, De Schutter and Van Brussel (1997), IEEE Transactions on Robotics and Automation 13, 730, excite robots with.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_FASTEST = 3.0  # Hz: what drives of legged and wheeled machines still follow
_HARMONICS = (1, 2, 3, 5, 8, 13, 21)  # of one period a sequence; those up to the fastest are used
_SHOWN = 0.1  # of the largest: spread from which a set of controls that moved together counts
_FADE = 0.3  # s, over which a sequence leaves the resting command and returns to it


@dataclass(frozen=True)
class Family:
    """A kind of motion: `say` names it in a sentence, `make` draws commands (T, nu) in -1..1 at times (T,).

    `takes_turns`: it makes sense with several sets of controls only.
    """

    name: str
    say: str
    make: Callable[[np.random.Generator, Array, int], Array]
    takes_turns: bool = False


def _sines(rng: np.random.Generator, time: Array, count: int, low: float, high: float) -> Array:
    """Three sines of random frequency and phase for each actuator."""
    f = np.exp(rng.uniform(np.log(low), np.log(high), (3, count)))
    phase = rng.uniform(0, 2 * np.pi, (3, count))
    return np.sin(2 * np.pi * f * time[:, None, None] + phase).sum(1) / 2


def _held(rng: np.random.Generator, time: Array, count: int, shortest: float, longest: float) -> Array:
    """Levels drawn anew after holds of random length."""
    out = np.empty((len(time), count))
    for column in out.T:
        edges = np.cumsum(rng.uniform(shortest, longest, int(time[-1] / shortest) + 2))
        column[:] = rng.uniform(-1, 1, len(edges) + 1)[np.searchsorted(edges, time)]
    return out


def _pulses(rng: np.random.Generator, time: Array, count: int) -> Array:
    """Half a second of command, then rest for as long again or longer."""
    edges = np.cumsum(np.tile([0.5, 1.0], int(time[-1] / 1.5) + 2))
    at = np.searchsorted(edges, time)
    levels = rng.choice([-1.0, -0.5, 0.5, 1.0], (at.max() + 1, count))
    return np.where(at[:, None] % 2 == 0, levels[at], 0.0)


def _chirp(rng: np.random.Generator, time: Array, count: int) -> Array:
    """From one swing a sequence to the fastest, through every frequency."""
    low, high, whole = 1 / time[-1], _FASTEST, time[-1]
    rate = np.log(high / low) / whole
    phase = 2 * np.pi * low * np.expm1(rate * time) / rate
    return np.sin(phase[:, None] + rng.uniform(0, 2 * np.pi, count))


def _turns(rng: np.random.Generator, time: Array, count: int) -> Array:
    """One actuator after the other, each for its share of the time."""
    phase = time / time[-1] * count
    turn = np.minimum(phase.astype(int), count - 1)
    edge = np.clip(8 * np.minimum(phase - turn, 1 + turn - phase), 0, 1)  # led in and out
    return np.where(turn[:, None] == rng.permutation(count), edge[:, None] * _sines(rng, time, count, 0.5, 2.0), 0.0)


def _stairs(rng: np.random.Generator, time: Array, count: int) -> Array:
    """Up a staircase of levels and down again, through rest and both signs."""
    phase = (time[:, None] / time[-1] + rng.uniform(0, 1, count)) % 1
    return np.round(4 * (1 - 4 * np.abs(phase - 0.5))) / 4


FAMILIES = (
    Family("slow", "slow swings", lambda r, t, n: _sines(r, t, n, 1 / t[-1], max(0.5, 1.5 / t[-1]))),
    Family("fast", "fast swings", lambda r, t, n: _sines(r, t, n, 0.8, _FASTEST)),
    Family("broad", "swings of all speeds at once", lambda r, t, n: _sines(r, t, n, 1 / t[-1], _FASTEST)),
    Family("chirp", "swings that go from slow to fast", _chirp),
    Family("steps", "steps that are held for half a second to two", lambda r, t, n: _held(r, t, n, 0.5, 2.0)),
    Family("jumps", "quick steps", lambda r, t, n: _held(r, t, n, 0.1, 0.4)),
    Family("pulses", "pushes with free motion between them", _pulses),
    Family("stairs", "a staircase of levels up and down", _stairs),
    Family("turns", "one set of actuators after the other", _turns, takes_turns=True),
)


def faded(w: Array, time: Array) -> Array:
    """The sequence (..., T, nu), led from rest and back to it."""
    edge = np.clip(np.minimum(time, time[-1] - time) / min(_FADE, time[-1] / 4), 0, 1)
    return w * (edge * edge * (3 - 2 * edge))[:, None]


class Series:
    """A drawn sequence times a gain plus a Fourier series, squeezed into -1..1: what the optimiser walks in.

    Args:
      start: (T, m) the sequence to improve.
      pattern: (m, nu) sets of controls that move together.
      time: (T,) s.
      most: coefficients at most; with many sets fewer harmonics are used.
    """

    def __init__(self, start: Array, pattern: Array, time: Array, most: int = 60) -> None:
        self.start, self.pattern, self.time, self.count = start, pattern, time, start.shape[1]
        use = [h for h in _HARMONICS if h / time[-1] <= _FASTEST][: max(1, most // (2 * self.count))]
        waves = 2 * np.pi * np.outer(time / time[-1], use)
        self.basis = np.concatenate([np.sin(waves), np.cos(waves), np.ones((len(time), 1))], 1)
        self.size = 1 + self.basis.shape[1] * self.count

    def __call__(self, z: Array) -> Array:
        """(T, nu) commands in -1..1 at coefficients z (size,); z = 0 is the start itself, but for the squeezing."""
        s = np.exp(z[0]) * self.start + self.basis @ z[1:].reshape(-1, self.count)
        return faded(squeezed(s @ self.pattern), self.time)


def patterns(commands: Array) -> list[Array]:
    """Sets of controls that may be moved together, (m, nu) each: as logged commands (T, nu) moved, and one by one.

    A vehicle's wheels, driven each for itself, only fight: what moved together in the logs may be tried together.
    """
    alone = np.eye(commands.shape[1])
    spread = commands - commands.mean(0)
    size = spread.std(0)
    if commands.shape[1] == 1 or not (size > 0).any():
        return [alone]
    _, values, modes = np.linalg.svd(spread / np.where(size > 0, size, 1.0), full_matrices=False)
    kept = modes[values > _SHOWN * values[0]] * size
    if len(kept) == len(alone):
        return [alone]
    together = kept / np.maximum(np.abs(kept).max(1, keepdims=True), 1e-12)
    return [together, together, alone]


def squeezed(w: Array) -> Array:
    """Smoothly into -1..1: nearly unchanged up to a half."""
    return w / (1 + w**6) ** (1 / 6)
