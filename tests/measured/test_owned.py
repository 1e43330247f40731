"""A model that has hardly moved expects the noise that it told before."""

import mujoco
import numpy as np
import pytest

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
    ("damping", "level", "same"),
    [(0.2, 0.1, True), (0.205, 0.1, True), (0.195, 0.1, True), (0.215, 0.1, False), (0.2, 0.4, False)],
)
def test_noise_is_heard_again_where_it_was_told_near_by(damping: float, level: float, same: bool) -> None:
    """Psi within a twentieth of itself, however wide its bounds are; effects within a twentieth of a realistic size."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    space = ParameterSpace(model, [Parameter("damping", "dof_damping", ("wheel",), "N m s", 0.0, 10.0)])
    friction = build("coulomb", "wheel", {"level": 0.1})[0]
    plant = Plant(model, space, [friction], nthread=1)
    told = [(plant, np.array([0.2, 0.1])), (plant, np.array([0.5, 0.1]))]
    model_now = plant.with_effects([friction]), np.array([damping, level])
    assert heard(model_now, told) is (told[0] if same else model_now)
    assert heard(model_now, []) is model_now
    bare = Plant(model, space, nthread=1), np.array([0.2])
    assert heard(bare, told) is bare
