"""Logs with gaps in their time are refused, or cut there into logs of their own."""

import numpy as np
import pytest
from conftest import Build, columns

from nfc_gym.core import InputError
from nfc_gym.measured.checks import check, require
from nfc_gym.measured.dataset import load
from nfc_gym.measured.predict import predict
from nfc_gym.physics.effects.base import TIME

CUT = ("time: {column: t}", "time: {column: t, gaps: cut}")
LOST = ((100, 140), (170, 200))  # rows; what is left is of 1 s, 0.3 s (less than a segment of 0.4 s) and 2 s


def lose(table: dict[str, np.ndarray]) -> None:
    kept = np.ones(len(table["t"]), bool)
    for first, end in LOST:
        kept[first:end] = False
    table.update({k: v[kept] for k, v in table.items()})


def test_stretches_between_gaps_are_logs_that_hold_what_was_recorded_then(build: Build) -> None:
    dataset, whole = load(build(lose, CUT)), columns(0)
    assert [log.name for log in dataset.logs] == [f"run_{k}/{n}" for k in range(3) for n in (1, 3)]
    assert dataset.whole == tuple(log.name for log in dataset.logs)
    for log, (start, stop) in zip(dataset.logs[:2], ((0, 100), (200, 400)), strict=True):
        np.testing.assert_array_equal(log.channels["joint:hinge:pos"].values, whole["q"][start:stop])
        np.testing.assert_allclose(log.time, 0.01 * np.arange(stop - start), atol=1e-12)
        np.testing.assert_allclose(log.exogenous[TIME], whole["t"][start:stop], atol=1e-12)
        assert log.inputs.time[0] == 0  # nothing is known of what drove the machine in a gap
    assert set(dataset.splits) == set(dataset.whole)


def test_check_says_that_logs_were_cut_and_finds_no_fault_in_the_gaps(build: Build) -> None:
    (note,) = check(build(lose, CUT))
    assert (note.severity, note.where) == ("note", "time")
    assert "in 3 of 3 logs, first run_0: " in note.message
    assert "cut at its gaps: 2 stretches, 2.98 s in all" in note.message


def test_logs_are_counted_whole_though_each_has_several_stretches(build: Build) -> None:
    """A channel that rests in both stretches of the two logs that have it resting is said of two logs of three."""

    def stuck(table: dict[str, np.ndarray]) -> None:
        lose(table)
        if table["q"][0] != columns(0)["q"][0]:
            table["gy"][:] = 0.25

    (found,) = [f for f in check(build(stuck, CUT)) if f.where == "channels.sensor:gyro"]
    assert found.message.startswith("in 2 of 3 logs, first run_1/1: ")


def test_whole_logs_stay_as_they_are(build: Build) -> None:
    assert [log.name for log in load(build(None, CUT)).logs] == ["run_0", "run_1", "run_2"]


def test_predictions_of_stretches_that_are_cut_by_time_too_are_joined(build: Build) -> None:
    mapping = build(lose, (CUT[0], CUT[1] + "\nsplit: {by: time}"), ("length: 0.4", "length: 0.15"), logs=1)
    found = predict(mapping, None, "rollout", "nominal", mapping.with_name("out.npz"))
    assert {name: len(rows) for name, rows in found.items()} == {"run_0/1": 100, "run_0/2": 30, "run_0/3": 200}


def test_where_no_stretch_is_as_long_as_a_segment_the_log_is_refused(build: Build) -> None:
    with pytest.raises(InputError, match=r"none of the 3 stretches between its gaps is as long as a segment, 2\.5 s"):
        require(build(lose, CUT, ("length: 0.4", "length: 2.5")))


def test_rows_an_interval_apart_have_no_gaps(build: Build) -> None:
    with pytest.raises(InputError, match="leave out `gaps`"):
        load(build(None, (CUT[0], "time: {interval: 0.01, gaps: cut}")))
