"""Stamps that scatter: what was measured says whether the samples were taken at them or at an even beat."""

from pathlib import Path

import numpy as np
import pytest

from nfc_gym.measured.checks import require
from nfc_gym.measured.even import evened
from tests.measured.arm import machine

ROWS, DT, SCATTER = 600, 0.005, 1e-4


def motion(time: np.ndarray, noise: float = 1e-5) -> np.ndarray:
    moved = np.sin(2 * np.pi * 1.3 * time) + 0.4 * np.sin(2 * np.pi * 2.1 * time)
    return (moved + noise * np.random.default_rng(1).normal(size=len(time)))[:, None]


def stamps(drift: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """When samples are due, and the stamps that scatter about that."""
    even = DT * np.arange(ROWS) + drift * np.sin(np.linspace(0, np.pi, ROWS))
    return even, even + SCATTER * np.random.default_rng(0).normal(size=ROWS)


@pytest.mark.parametrize("drift", [0.0, 0.002])
def test_samples_of_an_even_beat_get_their_times_back(drift: float) -> None:
    """Also where the clock drifts by 20 times the scatter."""
    even, stamped = stamps(drift)
    found = evened(stamped, [motion(even)])
    assert found is not None
    off = found.time - found.time[0] - (even - even[0])
    assert (off - off.mean())[30:-30].std() < SCATTER / 4
    assert found.scatter == pytest.approx(SCATTER, rel=0.1)
    assert found.interval == pytest.approx(DT, rel=1e-3)


def test_lost_rows_are_counted() -> None:
    even, stamped = stamps()
    kept = np.delete(np.arange(ROWS), [50, 51, 300])
    found = evened(stamped[kept], [motion(even)[kept]])
    assert found is not None
    np.testing.assert_allclose(np.diff(found.time), np.diff(even[kept]), atol=SCATTER / 4)


def test_stamps_of_uneven_samples_stand() -> None:
    stamped = stamps()[1]
    assert evened(stamped, [motion(stamped)]) is None


def test_stamps_stand_where_one_channel_speaks_for_them_or_none_says_anything() -> None:
    even, stamped = stamps()
    assert evened(stamped, [motion(even), motion(stamped)]) is None
    assert evened(stamped, [motion(even, noise=0.01)]) is None
    assert evened(stamped, [np.zeros((ROWS, 1))]) is None
    assert evened(even, [motion(even)]) is None


@pytest.mark.parametrize("taken", ["evenly", "as stamped"])
def test_check_says_what_is_taken_for_the_times(tmp_path: Path, taken: str) -> None:
    """The arm's encoder is coarse beside its own motion; here it is a good one."""
    path = machine(tmp_path, edits=(("q, unit: rad, noise: 0.002", "q, unit: rad"),))
    even, stamped = stamps()
    at = even if taken == "evenly" else stamped
    for file in tmp_path.glob("*.csv"):
        rows = np.column_stack([stamped, np.cos(3 * at), motion(at)[:, 0], np.gradient(motion(at)[:, 0], at)])
        np.savetxt(file, rows, delimiter=",", header="t,torque,q,v", comments="", fmt="%.17g")
    dataset, findings = require(path)
    told = [f.message for f in findings if f.where.endswith("time")]
    off = np.abs(np.diff(dataset.logs[0].time) - DT).max()
    if taken == "evenly":
        assert "its stamps scatter by 0.1 ms about rows 5 ms apart" in told[0]
        assert off < SCATTER / 4
    else:
        assert not told
        assert off > SCATTER
