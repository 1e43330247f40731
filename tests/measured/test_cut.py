"""Where segments begin and what they are compared at: within the log, at a sample beside the start."""

import numpy as np
import pytest

from nfc_gym.core import Channel, InputError, Log
from nfc_gym.measured.segments import Layout, cut

LAYOUT = Layout(0.4, 0.0, (0.05, 0.1, 0.2, 0.4), 0.4, 0.005)


def log(interval: float, rows: int = 60, jitter: float = 0.0) -> Log:
    late = jitter * interval * np.random.default_rng(0).uniform(0, 1, rows)
    time = interval * np.arange(rows) + late
    return Log("run", time - time[0], {}, {"joint:hinge:pos": Channel(np.sin(time), "rad")})


def test_samples_far_apart_hold_no_segment() -> None:
    """As of times in ms that were declared as s."""
    with pytest.raises(InputError, match=r"no segment of 0\.4 s holds a sample .* 10 s apart; check time\.unit"):
        cut([log(10.0)], LAYOUT)
    with pytest.raises(InputError, match=r"no log is long enough for one segment of 0\.4 s"):
        cut([log(0.01, 20)], LAYOUT)


def test_slow_logs_are_left_out_beside_others() -> None:
    where = cut([log(10.0), log(0.01)], LAYOUT)
    alone = cut([log(0.01)], LAYOUT)
    assert set(where.log) == {1}
    np.testing.assert_array_equal(where.start, alone.start)
    np.testing.assert_array_equal(where.samples, alone.samples)


@pytest.mark.parametrize("jitter", [0.0, 0.9])
@pytest.mark.parametrize("interval", [0.01, 0.07, 0.13, 0.3, 0.39, 0.4, 0.43, 0.5, 0.79])
def test_every_segment_holds_a_sample_beside_its_start(interval: float, jitter: float) -> None:
    one = log(interval, jitter=jitter)
    where = cut([one], LAYOUT)
    assert len(where.log)
    assert where.samples.max() < len(one)
    assert (where.samples.max(1) > where.start).all()
    np.testing.assert_allclose(where.step * LAYOUT.dt, one.time[where.samples] - one.time[where.start][:, None])


def test_segments_follow_each_other_to_the_end() -> None:
    np.testing.assert_array_equal(cut([log(0.01, 121)], LAYOUT).start, [0, 40, 80])
    np.testing.assert_array_equal(cut([log(0.01, 120)], LAYOUT).start, [0, 40])
