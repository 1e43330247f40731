"""`Log`: what it refuses, and that parts of it are the rows they claim."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nfc_gym import InputError, MissingExtra, NfcError
from nfc_gym.core import Channel, Log


def log(rows: int = 10, **changes: Any) -> Log:
    t = np.arange(rows) * 0.1
    parts = {
        "time": t,
        "controls": {"ctrl:a": t * 2},
        "channels": {"joint:j:pos": Channel(np.stack([t, t * 3], 1), mask=t > 0.5)},
        "exogenous": {"exo:volts": t + 7},
        "known": {"body_mass:b": t + 1},
        "servo": {"ctrl:a": {"gain": t + 5}},
        "group": "walk",
    }
    return Log(name="run", **(parts | changes))


@given(st.integers(2, 50), st.data())
def test_a_part_is_those_rows_with_time_from_zero(rows: int, data: st.DataObject) -> None:
    start = data.draw(st.integers(0, rows - 2))
    stop = data.draw(st.integers(start + 2, rows))
    whole = log(rows)
    part = whole.part(start, stop, "run@part")
    assert (part.name, part.group, len(part)) == ("run@part", "walk", stop - start)
    assert part.time[0] == 0
    np.testing.assert_allclose(part.time, whole.time[start:stop] - whole.time[start])
    np.testing.assert_array_equal(part.controls["ctrl:a"], whole.controls["ctrl:a"][start:stop])
    np.testing.assert_array_equal(part.exogenous["exo:volts"], whole.exogenous["exo:volts"][start:stop])
    np.testing.assert_array_equal(part.known["body_mass:b"], whole.known["body_mass:b"][start:stop])
    np.testing.assert_array_equal(part.servo["ctrl:a"]["gain"], whole.servo["ctrl:a"]["gain"][start:stop])
    ours, theirs = part.channels["joint:j:pos"], whole.channels["joint:j:pos"]
    np.testing.assert_array_equal(ours.values, theirs.values[start:stop])
    assert ours.mask is not None
    assert theirs.mask is not None
    np.testing.assert_array_equal(ours.mask, theirs.mask[start:stop])


@given(st.integers(4, 50), st.data())
def test_a_part_keeps_what_drove_the_robot_before_it_and_nothing_else(rows: int, data: st.DataObject) -> None:
    start = data.draw(st.integers(0, rows - 2))
    again = data.draw(st.integers(0, rows - start - 2))
    whole = log(rows)
    part = whole.part(start, rows, "run@part").part(again, rows - start, "run@part@part")
    inputs = part.inputs
    assert (part.before is None) == (start + again == 0)
    assert not hasattr(inputs, "channels")
    np.testing.assert_allclose(inputs.time, whole.time - whole.time[start + again], atol=1e-12)
    np.testing.assert_array_equal(inputs.controls["ctrl:a"], whole.controls["ctrl:a"])
    np.testing.assert_array_equal(inputs.exogenous["exo:volts"], whole.exogenous["exo:volts"])
    np.testing.assert_array_equal(inputs.known["body_mass:b"], whole.known["body_mass:b"])
    np.testing.assert_array_equal(inputs.servo["ctrl:a"]["gain"], whole.servo["ctrl:a"]["gain"])
    if part.before is not None:
        assert (part.before.time < 0).all()


def test_duration_and_interval() -> None:
    assert log(11).duration == pytest.approx(1.0)
    assert log(11).interval == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"time": np.array([0.0, 0.2, 0.1])},
            "time must increase, by 1e-09 s or more, but goes from 0.2 to 0.1 s at row 2",
        ),
        ({"time": 1e-300 * np.arange(3)}, "by 1e-09 s or more, but goes from 0 to 1e-300 s at row 1"),
        ({"time": np.array([0.0, 0.1, 0.1])}, "from 0.1 to 0.1 s at row 2"),
        ({"time": np.array([0.0])}, "two or more samples"),
        ({"time": np.zeros((4, 2))}, "must be a vector"),
        ({"controls": {"ctrl:a": np.zeros(3)}}, "ctrl:a has 3 rows where time has 10"),
        ({"channels": {"sensor:s": Channel(np.zeros((4, 2)))}}, "sensor:s has 4 rows"),
        ({"exogenous": {"exo:v": np.zeros(3)}}, "exo:v has 3 rows"),
    ],
)
def test_what_a_log_refuses(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        log(**changes)


def test_errors_have_one_root() -> None:
    assert issubclass(InputError, NfcError)
    assert issubclass(MissingExtra, NfcError)
    assert issubclass(MissingExtra, ImportError)  # so that `try: import` guards work
