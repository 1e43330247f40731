"""Numbers, intervals and units as the report writes them."""

import math
from typing import Any

import mujoco
import numpy as np
import pytest

from nfc_gym.measured import wording
from nfc_gym.physics.effects import build, propose
from nfc_gym.physics.effects.base import Scales
from nfc_gym.physics.effects.law import Law
from nfc_gym.physics.effects.words import together


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0123456, "0.0123"), (1234.5, "1234"), (0, "0"), (-0.5, "−0.500"), (1.2e-5, "1.20×10⁻⁵"), (-3e7, "−3.00×10⁷"),
     (0.09996, "0.100"), (99999.9, "1.00×10⁵"), (None, "–"), (math.nan, "–"), ("7", "–"), (np.float64(2), "2.00")],
)  # fmt: skip
def test_numbers(value: Any, text: str) -> None:
    assert wording.number(value) == text


@pytest.mark.parametrize("value", 10.0 ** np.linspace(-9, 9, 181))
def test_a_shown_number_is_within_half_a_unit_of_its_third_digit(value: float) -> None:
    shown = wording.number(value).replace("×10", "e").translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))
    assert abs(float(shown) - value) <= 0.005001 * value


def test_a_value_is_shown_to_the_precision_of_its_interval() -> None:
    assert wording.interval(0.10417, 0.1031, 0.1052) == ("0.1042", "0.1031 to 0.1052")
    assert wording.interval(52.1234, 40.0, 64.0) == ("52", "40 to 64")
    assert wording.interval(52.1234, None, None) == ("52.1", "–")
    assert wording.interval(1.0, 1.0, 1.0) == ("1.00", "1.00 to 1.00")


def test_units_of_one_are_not_written() -> None:
    assert wording.quantity(0.4, "1") == "0.400"
    assert wording.quantity(0.4, "m/s") == "0.400\N{NO-BREAK SPACE}m/s"
    assert wording.quantity(None, "m") == "–"


def test_every_smooth_law_of_one_variable_has_words() -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="knee"/><geom size="0.1"/></body></worldbody></mujoco>'
    )
    scales = Scales(*(np.ones(1) for _ in range(4)), 0.01)
    smooth = [e.id for e in propose(model, scales) if e.generic and not isinstance(e, Law)]
    assert len({wording.smooth(i) for i in smooth}) == len(smooth) > 0
    assert wording.smooth("generic_memory:knee") == "a smooth force by its past at knee"


@pytest.mark.parametrize(("names", "said"), [("a", "a"), ("ab", "a and b"), ("abcd", "a, b, c and d")])
def test_names_have_commas_and_one_and(names: str, said: str) -> None:
    assert together(list(names)) == said
    assert build("coulomb", list(names), {"level": 0.25})[0].say(np.array([0.25])).startswith(
        f"Dry (Coulomb) friction at {said}: level 0.25"
    )  # fmt: skip
