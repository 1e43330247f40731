"""Where segments begin and what they are compared at: within the log, at a sample beside the start."""

import time
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from nfc_gym.core import Channel, InputError, Log
from nfc_gym.measured.cuts import Layout, cut
from nfc_gym.measured.segments import commanded
from nfc_gym.measured.states import estimate_states

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
    np.testing.assert_array_equal(cut([log(0.01, 100)], LAYOUT).start, [0, 40])


def test_where_half_a_segment_would_be_left_over_one_more_ends_with_the_log() -> None:
    """Not where it would start beside a step of a command, or in a stretch that is masked; then before that."""
    np.testing.assert_array_equal(cut([log(0.01, 119)], LAYOUT).start, [0, 40, 78])
    known = replace(LAYOUT, put_off=False)
    np.testing.assert_array_equal(cut([log(0.01, 119)], known).start, [0, 40])
    time = 0.01 * np.arange(110)
    one = replace(log(0.01, 110), controls={"ctrl:motor": np.where(time > 0.685, 1.0, 0.0)})
    np.testing.assert_array_equal(cut([one], LAYOUT).start, [0, 40, 66])
    np.testing.assert_array_equal(cut([masked((62, 70), rows=110)], LAYOUT).start, [0, 40])


def test_no_start_lies_where_commands_before_the_log_are_felt() -> None:
    """Short of half of a log; of a part of one, what came before is known."""
    late = replace(LAYOUT, unknown=0.25)
    one = log(0.01, 201)
    np.testing.assert_array_equal(cut([one], late).start, [25, 65, 105, 145])
    np.testing.assert_array_equal(cut([one], replace(LAYOUT, unknown=9.0)).start, [81, 121, 161])
    part = one.part(100, 201, "run@verify")
    np.testing.assert_array_equal(cut([part], late).start, cut([part], LAYOUT).start)


def test_no_start_lies_where_a_late_drive_is_at_commands_of_before_the_log() -> None:
    """In the first tenth of a second, where commands move as the log begins and effects may remember."""
    remembers, time = replace(LAYOUT, history=0.5), 0.01 * np.arange(201)
    for rest, first in ((0.0, 10), (0.15, 0)):
        one = replace(log(0.01, 201), controls={"ctrl:motor": np.sin(3 * np.maximum(time - rest, 0.0))})
        starts = [*(first + 40 * np.arange(4)), 160]  # the log ends with the last
        np.testing.assert_array_equal(cut([one], remembers).start, starts)
        assert cut([one], LAYOUT).start[0] == 0
        assert cut([one], replace(remembers, put_off=False)).start[0] == 0
        part = one.part(100, 201, "run@verify")
        assert cut([part], remembers).start[0] == 0


def stepping(interval: float = 0.01, rows: int = 240, every: float = 0.4, until: float = np.inf) -> Log:
    time = interval * np.arange(rows)
    goal = np.where(time < until, np.floor(time / every + 1e-9) % 2, 0.0)
    return Log("run", time, {"ctrl:motor": goal}, {"joint:hinge:pos": Channel(np.sin(time), "rad")})


def test_no_start_lies_beside_a_step_of_a_command() -> None:
    """With steps at every start of the grid, and with a few."""
    for one in (stepping(), stepping(every=0.33), stepping(until=0.81)):
        steps = np.flatnonzero(np.diff(one.controls["ctrl:motor"])) + 1
        where = cut([one], LAYOUT)
        assert len(steps) >= 2
        assert np.abs(where.start[:, None] - steps).min() >= 3
        assert (np.diff(one.time[where.start])[:-1] >= LAYOUT.stride - 1e-9).all()
        assert np.diff(one.time[where.start])[-1] >= LAYOUT.stride / 2 - 1e-9
        assert len(where.start) >= 4
        np.testing.assert_allclose(where.step * LAYOUT.dt, np.tile(LAYOUT.horizons, (len(where.start), 1)))


def test_starts_stay_where_every_row_is_beside_a_step() -> None:
    busy = stepping(every=0.02)
    np.testing.assert_array_equal(cut([busy], LAYOUT).start, cut([log(0.01, 240)], LAYOUT).start[:-1])


def masked(*stretches: tuple[int, int], rows: int = 241) -> Log:
    one = log(0.01, rows)
    seen = np.ones(rows, bool)
    for first, end in stretches:
        seen[first:end] = False
    return replace(one, channels={"joint:hinge:pos": replace(one.channels["joint:hinge:pos"], mask=seen)})


def test_no_start_lies_in_a_masked_stretch() -> None:
    """Of 0.5 s, which is longer than a segment; nor where half of a cubic's seven samples lie beyond it."""
    np.testing.assert_array_equal(cut([masked((70, 120))], LAYOUT).start, [0, 40, 123, 163, 200])
    np.testing.assert_array_equal(cut([masked((0, 20))], LAYOUT).start, [14, 54, 94, 134, 174, 200])
    np.testing.assert_array_equal(cut([masked((150, 241))], LAYOUT).start, [0, 40, 80, 120])


def test_starts_stay_where_single_rows_are_masked() -> None:
    """Or all alike: a sensor that is slower than the log, whose rows between two samples are masked."""
    whole = cut([log(0.01, 241)], LAYOUT).start
    np.testing.assert_array_equal(cut([masked((39, 42), (80, 81), (119, 120))], LAYOUT).start, whole)
    np.testing.assert_array_equal(cut([masked(*[(k, k + 4) for k in range(1, 240, 5)])], LAYOUT).start, whole)
    np.testing.assert_array_equal(cut([masked((5, 241))], LAYOUT).start, whole)


def test_starts_are_known_as_well_as_they_say_beside_masked_stretches() -> None:
    one = masked((70, 100))
    fast = replace(one.channels["joint:hinge:pos"], values=np.sin(9 * one.time), noise=5e-4)
    one = replace(one, channels={"joint:hinge:pos": fast})
    joint = '<body><joint name="hinge"/><geom size=".1" mass="1"/></body>'
    states = estimate_states(mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{joint}</worldbody></mujoco>"), one)
    at = cut([one], LAYOUT).start
    off = np.abs(states.qpos[:, 0] - np.sin(9 * one.time))
    assert off[80] > 20 * states.qpos_sd[80, 0]  # a start would have lain here
    assert (off[at] < states.qpos_sd[at, 0]).all()


def test_a_step_of_the_physics_gets_the_mean_of_its_commands() -> None:
    """What is commanded every 10 ms, in steps of 4 ms: none of it is late."""
    time = 0.01 * np.arange(5)
    values = np.array([0.0, 1.0, -1.0, 3.0, 2.0])
    at = 0.004 * np.arange(-1, 13)
    got = commanded(time, values, at, 0.004, linear=False)
    np.testing.assert_allclose(got, [0, 0, 0, 0.5, 1, 1, -1, -1, 1, 3, 3, 2, 2, 2], atol=1e-12)
    dividing = 0.002 * np.arange(25)  # to the bit
    np.testing.assert_array_equal(commanded(time, values, dividing, 0.002, linear=False), np.repeat(values, 5))
    np.testing.assert_allclose(commanded(time, values, np.array([0.015]), 0.004, linear=True), [0.0], atol=1e-12)


def test_speeds_at_starts_do_not_lean_to_the_command() -> None:
    """Of a mass that a stepping force moves to and fro: a curve through both sides of a step is wrong by the force."""
    time = 0.01 * np.arange(400)
    force = np.where(np.floor(time / 0.4 + 1e-9) % 2 == 0, 20.0, -20.0)
    v = np.concatenate([[0.0], np.cumsum(force[:-1] * 0.01)])
    x = np.concatenate([[0.0], np.cumsum(v[:-1] * 0.01 + 0.5 * force[:-1] * 0.01**2)])
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="rail" type="slide"/><geom size="0.1"/></body></worldbody>'
        '<actuator><motor name="motor" joint="rail"/></actuator></mujoco>'
    )
    one = Log("run", time, {"ctrl:motor": force}, {"joint:rail:pos": Channel(x, "m", noise=1e-4)})
    states = estimate_states(model, one)
    off = np.abs(states.qvel[:, 0] - v)
    assert off[40:361:40].min() > 0.05  # m/s, at the steps
    assert off[cut([one], LAYOUT).start[1:]].max() < 1e-6


@pytest.mark.parametrize("jitter", [0.0, 0.9])
def test_samples_are_those_nearest_to_the_horizons(jitter: float) -> None:
    one = log(0.01, 400, jitter)
    where = cut([one], LAYOUT)
    for start, samples in zip(where.start, where.samples, strict=True):
        wanted = np.abs(one.time[:, None] - (one.time[start] + np.array(LAYOUT.horizons))).argmin(0)
        np.testing.assert_array_equal(samples, wanted)


def test_long_logs_are_cut_in_a_time_that_grows_with_their_length() -> None:
    def seconds(rows: int) -> float:
        begin = time.process_time()
        assert len(cut([log(0.001, rows)], LAYOUT).start) > rows / 500
        return time.process_time() - begin

    assert seconds(400_000) < 2  # looking at every row for each segment takes tens of seconds
