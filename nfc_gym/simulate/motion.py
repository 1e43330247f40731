"""Rich motion: band-limited signals in [-1, 1], one for each channel of a robot, from uniform numbers.

A window's signal is of one of five kinds: several sines at once, a chirp, steps that are held, a random walk, and a
gait (all channels at one frequency, each with a phase and a size of its own). Fourier series with bounded amplitude are
what Swevers, Ganseman, Tukel, De Schutter and Van Brussel (1997), IEEE Transactions on Robotics and Automation 13, 730,
excite robots with; the others reach what is seen in transients alone.
"""

import numpy as np

from nfc_gym.simulate.draws import Array, between, geometric, picked

KINDS = ("sines", "chirp", "steps", "walk", "gait")
BAND = (0.3, 4.0)  # Hz: slower than that is no motion within a window, faster hardly passes a servo
STRIDE = (0.8, 2.5)  # Hz, of gaits
HOLD = (0.1, 0.8)  # s, of steps
_SINES = 4
_OWN = 2 * _SINES + 2  # uniform numbers of a channel, beside its series


def count(steps: int, channels: int) -> int:
    """How many uniform numbers a window's signal is made of."""
    return 3 + channels * (_OWN + steps)


def signals(u: Array, steps: int, channels: int, dt: float, swing: tuple[float, float], offset: float) -> Array:
    """Signals (n, steps, channels).

    Args:
      u: (n, count) uniform numbers.
      steps, channels: of the result.
      dt: s, between steps.
      swing: least and most amplitude.
      offset: the mean of a channel lies at most so far off zero.
    """
    n = len(u)
    kind = picked(u[:, 0], len(KINDS))
    size = geometric(u[:, 1], *swing)
    own = u[:, 3 : 3 + channels * _OWN].reshape(n, channels, _OWN)
    series = u[:, 3 + channels * _OWN :].reshape(n, steps, channels)
    time: Array = dt * np.arange(steps, dtype=np.float64)
    wave = np.empty((n, steps, channels))
    for k, make in enumerate((_sines, _chirp, _steps, _walk, _gait)):
        rows = np.flatnonzero(kind == k)
        if len(rows):
            wave[rows] = make(u[rows, 2], own[rows], series[rows], time)
    middle = offset * (2 * own[..., -1] - 1)
    return np.clip(middle[:, None] + size[:, None, None] * wave, -1, 1)


def _sines(u: Array, own: Array, series: Array, time: Array) -> Array:
    """Four sines of random frequency and phase."""
    rate = 2 * np.pi * geometric(own[..., :_SINES], *BAND)[:, None]
    phase = 2 * np.pi * own[..., _SINES : 2 * _SINES][:, None]
    return np.sin(rate * time[:, None, None] + phase).sum(-1) / np.sqrt(_SINES / 2) / np.sqrt(2)


def _chirp(u: Array, own: Array, series: Array, time: Array) -> Array:
    """Through the band, upwards or downwards."""
    low, high = BAND
    growth = np.log(high / low) / time[-1]
    swept = 2 * np.pi * low * np.expm1(growth * time) / growth
    both = np.stack([swept, swept[-1] - swept[::-1]])[(u < 0.5).astype(int)]
    return np.sin(both[..., None] + 2 * np.pi * own[:, None, :, 0])


def _steps(u: Array, own: Array, series: Array, time: Array) -> Array:
    """Levels that are held, each channel in its own rhythm."""
    hold = geometric(own[..., 0], *HOLD)[:, None]
    turn = ((time[:, None] + hold * own[:, None, :, 1]) / hold).astype(np.intp)
    return 2 * np.take_along_axis(series, np.minimum(turn, len(time) - 1), 1) - 1


def _walk(u: Array, own: Array, series: Array, time: Array) -> Array:
    """Noise through a first-order filter at a frequency of the band: standard deviation a half."""
    keep = np.exp(-2 * np.pi * (time[1] - time[0]) * geometric(u, *BAND))[:, None]
    noise = np.sqrt(12) * (series - 0.5)  # of variance 1
    out = np.empty_like(series)
    level = noise[:, 0]
    for k in range(series.shape[1]):
        level = keep * level + np.sqrt(1 - keep * keep) * noise[:, k]
        out[:, k] = 0.5 * level
    return out


def _gait(u: Array, own: Array, series: Array, time: Array) -> Array:
    """One frequency and its octave."""
    turn = 2 * np.pi * geometric(u, *STRIDE)[:, None, None] * time[:, None]
    size, phase, second = own[:, None, :, 0], 2 * np.pi * own[:, None, :, 1], own[:, None, :, 2]
    return between(size, 0.3, 1.0) * np.sin(turn + phase) + 0.3 * second * np.sin(2 * turn + phase)
