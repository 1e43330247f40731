"""What calibration says on its way."""

from dataclasses import replace

import hinge
import pytest

from nfc_gym.measured.calibrate import calibrate
from nfc_gym.physics.parameters import Parameter, ParameterSpace
from nfc_gym.physics.rollout import Plant

FREE = Parameter("damping", "dof_damping", ("hinge",), low=0.0, high=1.0)


@pytest.mark.parametrize("declared", [[FREE], [replace(FREE, anchored=True)], []])
def test_nothing_is_said_of_calibration_where_nothing_is_free(declared: list[Parameter]) -> None:
    said: list[str] = []
    model = hinge.given()
    plant = Plant(model, ParameterSpace(model, declared))
    found = calibrate(hinge.problem([hinge.record(hinge.LAGGING, 0)]), plant, 0, said.append)
    assert len(found["x"]) == len(declared)
    assert any("calibrating psi, pass 1" in text for text in said) == (declared == [FREE])
    assert bool(said) == (declared == [FREE])
