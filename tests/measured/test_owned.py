"""A model that has hardly moved expects the noise that it told before."""

import mujoco
import numpy as np
import pytest

from nfc_gym.measured.fit import Fit
from nfc_gym.measured.owned import heard
from nfc_gym.physics.effects import build
from nfc_gym.physics.parameters import Parameter, ParameterSpace
from nfc_gym.physics.rollout import Plant

MODEL = """
<mujoco>
  <worldbody>
    <body><joint name="wheel" axis="0 1 0" damping="0.2"/><geom size="0.05" mass="0.1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize(
    ("damping", "level", "seen", "same"),
    [
        (0.2, 0.1, 1.0, True),
        (0.205, 0.1, 1.0, True),
        (0.195, 0.1, 1.0, True),
        (0.215, 0.1, 9.0, False),
        (0.2, 0.2, 9.0, False),
        (0.215, 0.1, 0.1, True),  # a damping that hardly shows
        (0.4, 0.1, 9.0, False),
    ],
)
def test_noise_is_heard_again_where_it_was_told_near_by(damping: float, level: float, seen: float, same: bool) -> None:
    """Psi within a twentieth of itself, however wide its bounds are; effects within a twentieth of a realistic size.

    A step of a scaled coordinate, here of 2.5 N m s, is seen as so many standard deviations for each 0.01 of it.
    """
    model = mujoco.MjModel.from_xml_string(MODEL)
    space = ParameterSpace(model, [Parameter("damping", "dof_damping", ("wheel",), "N m s", 0.0, 10.0)])
    friction = build("coulomb", "wheel", {"level": 0.1})[0]
    plant = Plant(model, space, [friction], nthread=1)
    told = [(plant, np.array([0.2, 0.1])), (plant, np.array([0.5, 0.1]))]

    def fit(plant: Plant, x: list[float]) -> Fit:
        return Fit(plant, np.array(x), np.ones((5, 3)), np.full((5, 3, len(x)), 100 * seen))

    now = fit(plant.with_effects([friction]), [damping, level])
    found = heard(now, told)
    assert (found is told[0]) == same
    assert same or found == (now.plant, now.x)
    assert heard(now, []) == (now.plant, now.x)
    assert (heard(fit(plant, [3.0, 3.0]), told, now.x) is told[0]) == same
    bare = fit(Plant(model, space, nthread=1), [0.2])
    assert heard(bare, told) == (bare.plant, bare.x)
