"""Excitation: within its range and band, rich in kinds, and its own in each window."""

import numpy as np
import pytest

from nfc_gym.simulate import motion

DT, STEPS, WIDE = 0.02, 400, 3


@pytest.fixture(scope="module")
def made() -> tuple[np.ndarray, np.ndarray]:
    """Kinds (n,) and signals (n, STEPS, WIDE) of amplitude 0.5 about 0."""
    u = np.random.default_rng(0).random((500, motion.count(STEPS, WIDE)))
    return (u[:, 0] * len(motion.KINDS)).astype(int), motion.signals(u, STEPS, WIDE, DT, (0.5, 0.500001), 0.0)


def test_signals_stay_within_their_range_and_fill_it(made: tuple) -> None:
    kinds, signals = made
    assert (np.abs(signals) <= 1).all()
    for k, name in enumerate(motion.KINDS):
        spread = signals[kinds == k].std()
        assert 0.1 < spread < 0.45, name


def test_power_lies_in_the_band(made: tuple) -> None:
    """Steps have edges, and a first-order filter's walk a tail; of the others hardly anything lies above the band."""
    kinds, signals = made
    power = np.abs(np.fft.rfft(signals * np.hanning(STEPS)[:, None], axis=1)) ** 2
    high = np.fft.rfftfreq(STEPS, DT) > 1.3 * motion.BAND[1]
    share = power[:, high].sum(1) / power[:, 1:].sum(1)
    for name, most in (("sines", 0.01), ("gait", 0.01), ("chirp", 0.1), ("walk", 0.5), ("steps", 0.3)):
        assert share[kinds == motion.KINDS.index(name)].mean() < most, name


def test_channels_and_windows_differ(made: tuple) -> None:
    _, signals = made
    flat = signals.transpose(0, 2, 1).reshape(-1, STEPS)
    alike = np.corrcoef(flat[:300])
    assert np.median(np.abs(alike[np.triu_indices(300, 1)])) < 0.2


def test_an_offset_moves_the_mean() -> None:
    u = np.random.default_rng(1).random((400, motion.count(STEPS, 1)))
    means = motion.signals(u, STEPS, 1, DT, (0.1, 0.100001), 0.6).mean((1, 2))
    assert 0.3 < means.std() < 0.4  # uniform within 0.6: 0.346
