"""Clock offsets: recovered to a fraction of a sample, with an honest deviation; none where there is none."""

from typing import Any

import numpy as np
import pytest

from nfc_gym.measured.offsets import clock_offset


def motion(rng: np.random.Generator) -> tuple[Any, Any]:
    """A position and its exact rate, functions of time (T,) -> (T, 3)."""
    size, speed, phase = rng.uniform(0.2, 1, (6, 3)), 2 * np.pi * rng.uniform(0.2, 3, (6, 3)), rng.uniform(0, 6, (6, 3))

    def position(t: np.ndarray) -> np.ndarray:
        return (size * np.sin(speed * t[:, None, None] + phase)).sum(1)

    def rate(t: np.ndarray) -> np.ndarray:
        return (size * speed * np.cos(speed * t[:, None, None] + phase)).sum(1)

    return position, rate


def test_the_offset_and_its_deviation_are_right() -> None:
    errors, scaled = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        position, rate = motion(rng)
        time_x, time_y = np.arange(0, 12, 0.01) + rng.uniform(0, 0.01), np.arange(0, 12, 0.005)
        true = rng.uniform(-0.3, 0.3)
        x = position(time_x) + 0.01 * rng.standard_normal((len(time_x), 3))
        y = 1.1 * rate(time_y - true) + 0.2 + 0.3 * rng.standard_normal((len(time_y), 3))
        found = clock_offset(time_x, x, time_y, y, 1.0)
        assert found is not None
        errors.append(found.seconds - true)
        scaled.append(errors[-1] / found.sd)
    assert np.sqrt(np.mean(np.square(errors))) < 0.0005  # a twentieth of the slower sensor's interval
    # Forty standard normals: their root mean square is within 0.66 to 1.34 of one with 99.7 %.
    assert 0.6 < np.sqrt(np.mean(np.square(scaled))) < 1.4


def test_periodic_motion_is_taken_at_its_nearest_period() -> None:
    t = np.arange(0, 20, 0.01)
    x, y = np.sin(5 * t)[:, None], 5 * np.cos(5 * (t - 0.03))[:, None]
    found = clock_offset(t, x, t, y, 4.0)
    assert found is not None
    assert found.seconds == pytest.approx(0.03, abs=1e-4)


def test_what_does_not_agree_has_no_offset_that_counts() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(0, 10, 0.01)
    position, _ = motion(rng)
    noise = clock_offset(t, position(t), t, rng.standard_normal((len(t), 3)), 1.0)
    assert noise is None or noise.correlation < 0.5
    assert clock_offset(t, position(t), t, np.zeros((len(t), 3)), 1.0) is None
    assert clock_offset(t[:20], position(t[:20]), t, position(t), 1.0) is None
