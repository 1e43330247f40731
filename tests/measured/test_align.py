"""What is known at some times comes back at others: exactly, or within the error of the interpolation formula."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from nfc_gym.core import InputError
from nfc_gym.measured.align import GAP, Use, align, shifted
from nfc_gym.measured.readers import Stream, Streams
from nfc_gym.measured.resampling import Clock, held, interpolated, nearest_rows
from nfc_gym.physics.state import quat_difference, quat_multiply, vector_to_quat

NS = 10**9


def stream(name: str, seconds: np.ndarray, delay: float = 0.0, **columns: np.ndarray) -> Stream:
    stamps = np.round(np.asarray(seconds) * NS).astype(np.int64)
    return Stream(name, stamps, stamps + round(delay * NS), "header.stamp", columns)


@given(
    rate=st.floats(20, 400), base=st.floats(20, 400), offset=st.floats(0, 0.5), jitter=st.floats(0, 0.4),
    frequency=st.floats(0.1, 3), seed=st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_a_sine_comes_back_within_the_error_of_linear_interpolation(
    rate: float, base: float, offset: float, jitter: float, frequency: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    time = offset + (np.arange(int(3 * rate)) + rng.uniform(0, jitter, int(3 * rate))) / rate
    grid, omega = np.arange(0, 3, 1 / base), 2 * np.pi * frequency
    sensor = stream("/s", time, x=np.sin(omega * np.round(time * NS) / NS))
    found = align(Streams([sensor, stream("/b", grid)]), "/b.time", [Use(("/s.x",), "linear", True)])
    zero = min(sensor.stamps[0], 0)
    t, x = found.table["/b.time"] + zero / NS, found.table["/s.x"]
    there = np.isfinite(x)
    # |error| <= h^2 / 8 max |x''|, the bound of linear interpolation over an interval h
    bound = omega**2 / 8 * np.diff(time).max() ** 2
    assert np.abs(x[there] - np.sin(omega * t[there])).max() <= bound + 1e-6
    assert t[0] >= time[0] - 1e-9 - 1 / base
    assert t[-1] <= time[-1] + 1e-9
    interval = np.median(np.diff(time)) * base
    assume(abs(interval - 1.5) > 1e-6)  # on the very threshold stamps of whole nanoseconds decide
    slower = interval > 1.5
    assert there.all() == (not slower)
    if slower:  # the row nearest to each sample
        rows = np.unique(np.round((time[(time >= t[0]) & (time <= t[-1])] - t[0]) * base))
        assert there.sum() == pytest.approx(len(rows), abs=2)  # at either end a sample's nearest row may be cut off


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_slerp_of_a_constant_turn_is_exact(seed: int, scalar_last: bool) -> None:
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.01, 0.1, 40))
    rate, first = rng.normal(size=3), vector_to_quat(rng.normal(size=3))
    at = rng.uniform(time[0], time[-1], 60)

    def turn(t: np.ndarray) -> np.ndarray:
        return quat_multiply(first, vector_to_quat(rate * t[:, None]))

    signs = rng.choice([-1.0, 1.0], (40, 1))  # q and -q are one orientation
    values = turn(time) * signs
    order = np.roll(values, -1, axis=1) if scalar_last else values
    out = interpolated(time, order, at, np.inf, rotation=True)
    out = np.roll(out, 1, axis=1) if scalar_last else out
    np.testing.assert_allclose(quat_difference(turn(at), out), 0, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1, rtol=1e-12)


def test_half_a_turn_between_samples_goes_one_way_at_constant_speed() -> None:
    ends = vector_to_quat(np.array([[0, 0, 0.0], [0, 0, 3.0]]))
    out = interpolated(np.array([0.0, 1.0]), ends, np.array([0.0, 0.25, 0.5, 1.0]), np.inf, rotation=True)
    np.testing.assert_allclose(out, vector_to_quat(np.array([[0, 0, 3.0 * t] for t in (0, 0.25, 0.5, 1)])), atol=1e-12)


def test_commands_are_held_exactly() -> None:
    time, values = np.array([0.1, 0.2, 0.35]), np.array([[1.0], [2.0], [3.0]])
    out = held(time, values, np.array([0.0, 0.1, 0.15, 0.2, 0.3499, 0.35, 9.0]))[:, 0]
    np.testing.assert_array_equal(out, [np.nan, 1, 1, 2, 2, 3, 3])


def test_nothing_is_interpolated_over_a_gap_but_its_edges_stand() -> None:
    time = np.concatenate([np.arange(0, 1, 0.01), np.arange(1.5, 2, 0.01)])
    grid = np.arange(0, 1.99, 0.005)
    use = [Use(("/s.x",), "linear", True), Use(("/s.u",), "hold")]
    table = Streams([stream("/b", grid), stream("/s", time, x=time, u=time)])
    found = align(table, "/b.time", use)
    x = found.table["/s.x"]
    inside = (grid > time[99] + 1e-12) & (grid < 1.5 - 1e-12)
    missing = np.isnan(x)[np.isin(np.arange(len(grid)), np.flatnonzero(inside))]
    assert missing.all()
    told = {r.how: r for r in found.resampled}
    assert told["linear"].gap == pytest.approx(GAP * 0.01)
    assert told["linear"].longest == pytest.approx(0.51)
    assert told["linear"].missing == pytest.approx(inside[nearest_rows(time, grid)].mean(), abs=0.01)
    assert found.rates == {"/s.x": pytest.approx(100)}
    assert np.isfinite(found.table["/s.u"]).all()  # a command holds until the next


def test_a_slow_sensor_keeps_one_row_a_sample_and_a_fast_one_all() -> None:
    grid = np.arange(0, 2, 0.01)
    slow, fast = np.arange(0.003, 1.99, 0.1), np.arange(0, 2, 0.002)
    table = Streams([stream("/b", grid), stream("/slow", slow, x=slow), stream("/fast", fast, x=fast)])
    found = align(table, "/b.time", [Use(("/slow.x",), "linear", True), Use(("/fast.x",), "linear", True)])
    t, x = found.table["/b.time"], found.table["/slow.x"]
    kept = np.isfinite(x)
    assert kept.sum() == len(slow) - 1  # the first row lies before the first sample, and is cut off
    np.testing.assert_allclose(x[kept], t[kept], atol=1e-12)
    assert np.abs(t[kept, None] - slow).min(1).max() <= 0.005
    assert found.rates == {"/slow.x": pytest.approx(10)}
    np.testing.assert_allclose(found.table["/fast.x"], t, atol=1e-12)


def test_exogenous_signals_are_interpolated_in_every_row() -> None:
    grid, slow = np.arange(0, 2, 0.01), np.arange(0, 2.5, 0.5)
    table = Streams([stream("/b", grid), stream("/volts", slow, v=slow)])
    found = align(table, "/b.time", [Use(("/volts.v",), "linear")])
    np.testing.assert_allclose(found.table["/volts.v"], found.table["/b.time"], atol=1e-12)


def test_rows_that_a_stream_does_not_reach_are_cut_off_and_said() -> None:
    grid = np.arange(0, 10, 0.01)
    table = Streams(
        [stream("/b", grid, y=grid), stream("/u", np.arange(1, 2, 0.1), u=np.arange(10.0)),
         stream("/s", np.arange(0.5, 8, 0.02), x=np.arange(0.5, 8, 0.02))]
    )  # fmt: skip
    uses = [Use(("/u.u",), "hold"), Use(("/s.x",), "linear", True), Use(("/b.y",), "linear", True)]
    found = align(table, "/b.time", uses)
    assert found.cut == (pytest.approx(1.0), pytest.approx(grid[-1] - 7.98))
    assert found.cutters == ("/u", "/s")
    np.testing.assert_allclose(found.table["/b.y"], found.table["/b.time"])
    assert found.table["/u.u"][-1] == 9  # the last command holds on


def test_receive_times_serve_all_streams_where_the_base_is_named_so() -> None:
    wrong = stream("/s", np.arange(0, 2, 0.01) + 5000, x=np.arange(0, 2, 0.01))  # a sender whose clock began elsewhere
    wrong = Stream("/s", wrong.stamps, wrong.stamps - 5000 * NS, "header.stamp", wrong.columns)
    table = Streams([stream("/b", np.arange(0, 2, 0.01)), wrong])
    uses = [Use(("/s.x",), "linear", True)]
    with pytest.raises(InputError, match=r"no time in common .*/s 5000 to .*'/b\.received' as the time column"):
        align(table, "/b.time", uses)
    found = align(table, "/b.received", uses)
    np.testing.assert_allclose(found.table["/s.x"], found.table["/b.received"], atol=1e-12)
    assert {found.clock, *(r.clock for r in found.resampled)} == {"receive time"}


def test_stamps_out_of_order_and_repeated_are_sorted_and_counted() -> None:
    clock = Clock(np.array([0.0, 2.0, 1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(clock.time, [0, 1, 2, 3])
    np.testing.assert_array_equal(clock.order, [0, 2, 3, 4])
    assert (clock.repeated, clock.disordered) == (1, 1)


def test_a_clock_that_was_set_back_is_refused_and_messages_that_overtake_are_not() -> None:
    time = np.arange(0, 2, 0.01)
    late = np.where(time > 1, time - 0.3, time)
    base, use = stream("/b", time), [Use(("/s.x",), "linear", True)]
    with pytest.raises(InputError, match=r"times of /s go back by 0\.29 s at its message 101 .*'/b\.received'"):
        align(Streams([base, stream("/s", late, x=time)]), "/b.time", use)
    received = Stream("/s", stream("/s", late).stamps, base.stamps, "header.stamp", {"x": time})
    assert align(Streams([base, received]), "/b.received", use).table["/s.x"] == pytest.approx(time, abs=1e-9)
    swapped = np.arange(len(time))
    swapped[50:57] = [56, 50, 51, 52, 53, 54, 55]  # one message came six too soon
    overtaken = align(Streams([base, stream("/s", time[swapped], x=time[swapped])]), "/b.time", use)
    np.testing.assert_allclose(overtaken.table["/s.x"], time, atol=1e-9)
    two = time - np.where(np.arange(len(time)) % 20 == 0, 0, 0.1)  # a slow sender among a fast one's messages
    assert align(Streams([base, stream("/s", two, x=two)]), "/b.time", use).resampled[0].disordered == 10


def test_a_clock_that_moves_against_the_recorders_is_told_and_waiting_messages_are_not() -> None:
    rng, time = np.random.default_rng(0), np.arange(0, 20, 0.01)
    wait = 0.002 + rng.exponential(0.01, len(time))
    received = np.round((time + wait) * NS).astype(np.int64)
    use = [Use(("/s.x",), "linear", True)]

    def moved(by: np.ndarray) -> float:
        sensor = Stream("/s", np.round((time + by) * NS).astype(np.int64), received, "header.stamp", {"x": time})
        return align(Streams([stream("/b", time), sensor]), "/b.time", use).wandering["/s"]

    assert moved(np.zeros(len(time))) < 1e-3
    assert moved(1e-3 * time) == pytest.approx(0.018, abs=1e-3)  # between the middles of ten stretches
    assert moved(np.where(time > 13, 0.5, 0)) == pytest.approx(0.5, abs=1e-3)


def test_a_wrapped_angle_keeps_its_jump() -> None:
    time, grid = np.arange(0, 2, 1 / 130), np.arange(0, 1.9, 0.01)
    angle = np.angle(np.exp(1j * 4 * time))  # through half a turn at 0.785 s
    table = Streams([stream("/b", grid), stream("/s", time, x=angle, deg=np.rad2deg(angle))])
    turned = [Use(("/s.x",), "linear", True, turn=2 * np.pi), Use(("/s.deg",), "linear", True, turn=360.0)]
    found = align(table, "/b.time", turned)
    for values in (found.table["/s.x"], np.deg2rad(found.table["/s.deg"])):
        assert np.abs(np.diff(values)).max() == pytest.approx(2 * np.pi, abs=0.1)
        assert np.abs(values - np.angle(np.exp(1j * 4 * grid)))[np.abs(grid - np.pi / 4) > 0.02].max() < 1e-3
    shifted_by = [Use(("/s.x",), "linear", True, 0.0123, turn=2 * np.pi)]
    values = align(table, "/s.time", shifted_by).table[shifted("/s.x", 0.0123)]
    assert np.abs(np.diff(values)).max() == pytest.approx(2 * np.pi, abs=0.1)


def test_commands_that_stay_away_are_told_unless_they_come_when_there_is_need() -> None:
    grid = np.arange(0, 4, 0.01)
    use = [Use(("/u.u",), "hold")]

    def silent(sent: np.ndarray) -> float:
        return align(Streams([stream("/b", grid), stream("/u", sent, u=sent)]), "/b.time", use).resampled[0].silent

    assert silent(grid) == 0
    assert silent(grid[(grid < 1.005) | (grid > 2.195)]) == pytest.approx(1.2)
    assert silent(grid[grid < 3.005]) == pytest.approx(0.99)  # till the recording ends
    assert silent(grid[(grid < 1.005) | (grid > 1.035)]) == 0  # three in a row are no silence
    assert silent(np.cumsum(np.random.default_rng(0).exponential(0.1, 40))) == 0


def test_commands_that_wait_for_the_next_row_are_told() -> None:
    grid, sent = np.arange(0, 2, 0.01), np.arange(0.004, 1.9, 0.01)
    table = Streams([stream("/b", grid), stream("/u", sent, u=sent)])
    found = align(table, "/b.time", [Use(("/u.u",), "hold")])
    assert found.resampled[0].late == pytest.approx(0.006)
    exact = align(table, "/u.time", [Use(("/u.u",), "hold")])
    assert exact.resampled == ()


def test_what_cannot_be_brought_together_is_an_error() -> None:
    a = stream("/a", np.arange(5.0), w=np.ones(5), q=np.ones((5, 3)), raw=np.arange(5))
    b = stream("/b", np.arange(5.0), x=np.zeros(5))
    table = Streams([a, b], constants={"parameters.mass": 2.5})
    with pytest.raises(InputError, match="a quaternion needs one clock"):
        align(table, "/a.time", [Use(("/a.w", "/b.x"), "slerp", True)])
    with pytest.raises(InputError, match=r"'/b.x' has times of its own, and '/a.raw' is not a time.*/a.time, /b.time"):
        align(table, "/a.raw", [Use(("/b.x",), "linear")])
    with pytest.raises(InputError, match=r"'/a\.q' has entries 0 to 2"):
        align(table, "/b.time", [Use(("/a.q[7]",), "linear")])
    same = align(table, "/a.raw", [Use(("/a.w",), "linear", True), Use(("parameters.mass",), "linear")])
    np.testing.assert_array_equal(same.table["/a.w"], np.ones(5))
    assert same.table["parameters.mass"] == 2.5


def test_of_one_stream_some_columns_are_shifted_with_their_masks() -> None:
    time, late = 0.01 * np.arange(200), 0.0137
    flags = np.ones(200)
    flags[100] = 0
    base = stream("/b", time, x=2 * time, y=3 * time, good=flags)
    other = stream("/o", time, busy=flags)
    masks = [Use((name,), "both", shift=late, beside=("/b.y",)) for name in ("/b.good", "/o.busy")]
    use = [Use(("/b.x",), "linear", True), Use(("/b.y",), "linear", True, late), *masks]
    found = align(Streams([base, other]), "/b.time", use)
    grid = found.table["/b.time"]
    assert grid[-1] == pytest.approx(time[-1] - 0.02)  # 1.99 - 0.0137 is the last that was measured of y
    np.testing.assert_allclose(found.table["/b.x"], 2 * grid, atol=1e-12)
    np.testing.assert_allclose(found.table[shifted("/b.y", late)], 3 * (grid + late), atol=1e-9)
    # The row at 0.98 s takes y of 0.9937 s, that at 0.99 s y of 1.0037 s; the other stream has a clock of its own.
    np.testing.assert_array_equal(np.flatnonzero(found.table[shifted("/b.good", late)] == 0), [98, 99])
    np.testing.assert_array_equal(np.flatnonzero(found.table["/o.busy"] == 0), [100])
    assert {r.shift for r in found.resampled} == {late, 0.0}


def test_a_shift_needs_a_topics_own_times() -> None:
    time = 0.01 * np.arange(50)
    table = Streams([stream("/a", time, raw=time, w=time)])
    with pytest.raises(InputError, match=r"`shift` is taken from a topic's own times.*name one of /a\.time"):
        align(table, "/a.raw", [Use(("/a.w",), "linear", True, 0.01)])
