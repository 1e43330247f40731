"""Tests of numbers in sentences."""

import math

import pytest

from nfc_gym.physics.effects.words import with_spread


@pytest.mark.parametrize(
    ("value", "half", "said"),
    [
        (20.3067, 0.338, "20.31 ± 0.34"),
        (0.24123, 0.0012, "0.2412 ± 0.0012"),
        (297.2, 104.0, "300 ± 100"),
        (368.0, 104.0, "370 ± 100"),
        (17.7, 15.2, "18 ± 15"),
        (2.6e-6, 5.6, "0.0 ± 5.6"),  # nothing is known of it but its interval
        (-2.6e-6, 5.6, "0.0 ± 5.6"),
        (-1.24, 0.25, "-1.24 ± 0.25"),
        (0.25, 0.0196, "0.250 ± 0.020"),
        (9.99, 0.0999, "9.99 ± 0.10"),
        (3.2e-7, 1.1e-8, "3.2e-07 ± 1.1e-08"),
        (4.1e7, 2.3e6, "4.1e+07 ± 2.3e+06"),
    ],
)
def test_to_the_digits_that_are_known(value: float, half: float, said: str) -> None:
    assert with_spread(value, half / 1.96) == said


@pytest.mark.parametrize("sd", [None, math.nan, math.inf, 0.0])
def test_without_an_interval(sd: float | None) -> None:
    assert with_spread(0.123456, sd) == "0.123"
