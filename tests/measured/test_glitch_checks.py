"""Rows that stand off and sensors that freeze are told; fast motion, blows, coarse encoders and rest are not."""

import numpy as np
import pytest

from nfc_gym.core import Channel, Log
from nfc_gym.measured.glitch_checks import glitches

TIME = np.arange(0, 10, 0.01)
RNG = np.random.default_rng(0)
SWING = np.sin(3 * TIME) + 1e-3 * RNG.normal(size=len(TIME))
OTHER = np.cos(2 * TIME) + 1e-3 * RNG.normal(size=len(TIME))


def told(values: np.ndarray, name: str = "joint:a:pos", other: np.ndarray = OTHER, **how: object) -> list[str]:
    channels = {name: Channel(values, "rad", **how), "joint:b:pos": Channel(other, "rad")}  # type: ignore[arg-type]
    return [f"{s.where} {s.message}" for s in glitches(Log(name="l", time=TIME, controls={}, channels=channels))]


def test_rows_that_stand_off_are_counted() -> None:
    values = SWING.copy()
    values[[200, 500, 777]] += [1.5, -0.7, 0.9]
    (line,) = told(values)
    assert line.startswith("channels.joint:a:pos 3 single rows off by up to 1.47 rad, the first row 200")
    assert told(values, mask=values == SWING) == []
    assert told(values, "joint:a:vel") == []  # a blow does that


def test_a_frozen_sensor_is_told_while_others_move() -> None:
    values = SWING.copy()
    values[600:800] = values[600]
    (line,) = told(values)
    assert line.startswith("channels.joint:a:pos the same value in rows 600 to 799, for 1.99 s")
    rest = OTHER.copy()
    rest[590:810] = rest[590]
    assert told(values, other=rest) == []


@pytest.mark.parametrize(
    "values",
    [
        SWING,
        np.round(SWING / 0.02) * 0.02,  # a coarse encoder
        np.where(TIME > 5, SWING + 2, SWING),  # a jump that stays: moved, not misread
        np.where(np.abs(TIME - 5) < 0.05, SWING + 1, SWING),  # a motion of ten rows
        np.clip(SWING, -0.5, 0.5),  # at its stops
        np.where(TIME < 8, 0.0, np.sin(20 * TIME)),  # hardly ever moves
    ],
)
def test_what_can_have_moved_passes(values: np.ndarray) -> None:
    assert told(values) == []
