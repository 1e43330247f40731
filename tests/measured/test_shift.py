"""Rows without a clock; clock offsets in logs of one clock: exact where interpolation is, refused where senseless."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nfc_gym.core import Channel, InputError, Log
from nfc_gym.measured.checks import check
from nfc_gym.measured.dataset import load

Build = Any
Table = dict[str, np.ndarray]
ROWS, STEP = 400, 0.01  # of the logs that `build` writes, s


def late(shift: float, *more: str) -> tuple[str, str]:
    """The edit that shifts the joint's speed."""
    return 'unit: rad/s, noise: 0.01}\n  "body', f'unit: rad/s, {", ".join((f"shift: {shift!r}", *more))}}}\n  "body'


def only(path: Path) -> Log:
    return load(path).logs[0]


def speed(log: Log) -> Channel:
    return log.channels["joint:hinge:vel"]


def ramp(table: Table) -> None:
    """What linear interpolation gives back exactly."""
    table["v"] = 2 * table["t"] - 1


# ---- rows without a clock -------------------------------------------------------------------------------------------


def test_rows_without_a_clock_are_an_interval_apart(build: Build) -> None:
    timed = load(build()).logs

    def spoil(table: Table) -> None:
        del table["t"]
        table["amps"] = np.array(1.5)  # a constant has no rows to count by

    path = build(spoil, ("time: {column: t}", 'time: {interval: 0.02}\nexogenous: {"exo:a": {column: amps, unit: A}}'))
    for ours, theirs in zip(load(path).logs, timed, strict=True):
        np.testing.assert_allclose(ours.time, 2 * theirs.time, atol=1e-12)
        np.testing.assert_array_equal(ours.exogenous["exo:time"], ours.time)
        np.testing.assert_array_equal(ours.exogenous["exo:a"], np.full(ROWS, 1.5))
        for name, channel in ours.channels.items():
            np.testing.assert_array_equal(channel.values, theirs.channels[name].values)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda t: t.update(q=t["q"][:-3]), "column 'goal' has 400 rows and 'q' 397; `interval` wants as many of each"),
        (lambda t: t.pop("goal"), "no column 'goal'"),
        (lambda t: t.update({k: v[:1] for k, v in t.items()}), "no column has two or more samples"),
    ],
)
def test_columns_of_several_lengths_have_no_common_interval(
    build: Build, spoil: Callable[[Table], None], words: str
) -> None:
    with pytest.raises(InputError, match=re.escape(words)):
        load(build(spoil, ("time: {column: t}", "time: {interval: 0.01}")))


def test_a_time_column_that_is_not_there_may_be_an_interval(build: Build) -> None:
    with pytest.raises(
        InputError, match=r"no column 't'.*of a log without a clock say `interval`, the seconds from row"
    ):
        load(build(lambda t: t.pop("t")))


# ---- stamps that are late -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shift", [0.0073, -0.0251, 0.02, -0.01, 1e-6, 1.5])
def test_a_shift_is_taken_from_the_stamps_of_its_channel_alone(build: Build, shift: float) -> None:
    log, whole = only(build(ramp, late(shift))), only(build(ramp))
    first = np.ceil(-shift / STEP - 1e-9) if shift < 0 else 0
    taken = log.time + first * STEP  # by the clock of the file
    np.testing.assert_allclose(speed(log).values, 2 * (taken + shift) - 1, atol=1e-9)
    assert speed(log).mask is None
    assert abs(len(log) - (ROWS - abs(shift) / STEP)) <= 1.001  # rows that the shifted channel does not reach
    rows = slice(int(first), int(first) + len(log))
    np.testing.assert_array_equal(
        log.channels["joint:hinge:pos"].values, whole.channels["joint:hinge:pos"].values[rows]
    )
    np.testing.assert_array_equal(log.controls["ctrl:servo"], whole.controls["ctrl:servo"][rows])


def test_an_orientation_is_shifted_along_its_arc(build: Build) -> None:
    def turn(table: Table) -> None:
        table["qw"], table["qz"] = np.cos(0.4 * table["t"]), np.sin(0.4 * table["t"])

    log = only(build(turn, ("order: wxyz,", "order: wxyz, shift: 0.0137,")))
    angle = 0.4 * (log.time + 0.0137)
    quat = log.channels["body:base:quat"].values
    np.testing.assert_allclose(quat[:, [0, 3]], np.stack([np.cos(angle), np.sin(angle)], 1), atol=1e-12)


@pytest.mark.parametrize("bad", [1e6, np.nan])
def test_what_is_interpolated_from_a_masked_sample_is_masked(build: Build, bad: float) -> None:
    def spoil(table: Table) -> None:
        ramp(table)
        table["good"] = np.ones(ROWS)
        for row in (50, 120, 121):
            table["v"][row], table["good"][row] = bad, 0

    log = only(build(spoil, late(0.0035, "mask: good")))
    mask = speed(log).mask
    assert mask is not None
    # A row at t takes samples at t + 0.0035: of rows k and k + 1.
    np.testing.assert_array_equal(np.flatnonzero(~mask), [49, 50, 119, 120, 121])
    np.testing.assert_allclose(speed(log).values[mask], (2 * (log.time + 0.0035) - 1)[mask], atol=1e-9)


def test_of_a_held_column_the_renewals_are_shifted(build: Build) -> None:
    def hold(table: Table) -> None:
        table["v"] = (2 * table["t"] - 1)[(np.arange(ROWS) // 10) * 10]

    log = only(build(hold, late(0.037, "rate: 10")))
    mask = speed(log).mask
    assert mask is not None
    # Samples were taken at 0.1 k - 0.037 s; the nearest rows are at 0.1 k - 0.04 s.
    np.testing.assert_array_equal(np.flatnonzero(mask), np.arange(6, 387, 10))
    np.testing.assert_allclose(speed(log).values[mask], (2 * (log.time + 0.037) - 1)[mask], atol=1e-9)


def test_the_offset_that_check_advises_is_the_one_that_was_there(build: Build) -> None:
    true = 0.0331

    def spoil(table: Table) -> None:
        t, rng = table["t"] - true, np.random.default_rng(1)
        table["q"] = np.sin(3 * table["t"]) + 0.5 * np.sin(7 * table["t"] + 1)
        table["v"] = 3 * np.cos(3 * t) + 3.5 * np.cos(7 * t + 1) + 0.01 * rng.standard_normal(ROWS)

    finding = next(f for f in check(build(spoil)) if f.where == "channels.joint:hinge:vel")
    advised = re.search(r"to take it out, write `shift: (\S+)` under channels\.joint:hinge:vel", finding.advice)
    assert advised
    shift = float(advised[1])
    assert shift == pytest.approx(true, abs=0.001)
    path = build(spoil, late(shift))
    found = [f for f in check(path) if f.where == "channels.joint:hinge:vel"]
    assert [f.severity for f in found] == ["note"]
    assert "its stamps are taken to be 33" in found[0].message
    log = only(path)
    np.testing.assert_allclose(speed(log).values, 3 * np.cos(3 * log.time) + 3.5 * np.cos(7 * log.time + 1), atol=0.08)


@pytest.mark.parametrize(
    ("edits", "words"),
    [
        ([late(5.0)], "channels.joint:hinge:vel.shift: 5 s is no shorter than the log, 3.99 s; it is in seconds"),
        ([late(-3.99)], "channels.joint:hinge:vel.shift: -3.99 s is no shorter than the log"),
        ([late(2.1), ("order: wxyz,", "order: wxyz, shift: -2.1,")], "2.1 s, -2.1 s, leave fewer than two rows"),
        ([late(0.01), ("column: v,", "column: w,")], "channels.joint:hinge:vel: no column 'w'"),
        ([late(0.01, "mask: q")], "mask 'q (shift 0.01 s)' holds"),
    ],
)
def test_shifts_that_cannot_be_are_refused(build: Build, edits: list[tuple[str, str]], words: str) -> None:
    with pytest.raises(InputError, match=re.escape(words)):
        load(build(ramp, *edits))
