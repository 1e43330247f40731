"""The effect that `docs/effects.md` writes works as the page says."""

import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from nfc_gym.physics.effects.base import Effect, Scales
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.physics.rollout import Plant
from nfc_gym.physics.segments import Segments

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "effects.md").read_text(encoding="utf-8")
(PROGRAM,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
WHEEL = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody><body name="wheel"><joint name="axle" axis="0 0 1"/>
    <inertial pos="0 0 0" mass="1" diaginertia="0.05 0.05 0.05"/></body></worldbody>
</mujoco>
"""


def feather(model: mujoco.MjModel) -> Effect:
    names: dict[str, Any] = {}
    exec(PROGRAM, names)
    (found,) = names["Feather"].propose(model, Scales(np.ones(1), np.ones(1), np.zeros(0), np.zeros(0), 0.01))
    return found


@pytest.mark.parametrize(("speed", "resistance"), [(20.0, 0.003), (-20.0, 0.008)])
def test_a_free_spin_slows_as_the_page_says(speed: float, resistance: float) -> None:
    model = mujoco.MjModel.from_xml_string(WHEEL)
    plant = Plant(model, ParameterSpace(model, []), [feather(model)], nthread=1)
    steps = 1000
    segments = Segments(0.001, 0, np.zeros((1, 1)), np.full((1, 1), speed), np.zeros((1, steps, 0)))
    end = plant.shoot(np.array([[0.003, 0.008]]), segments).qvel[0, 0, -1, 0]
    time = steps * 0.001
    assert end == pytest.approx(speed / (1 + resistance * abs(speed) * time / 0.05), rel=2e-3)


def test_at_null_nothing_changes() -> None:
    model = mujoco.MjModel.from_xml_string(WHEEL)
    segments = Segments(0.001, 0, np.zeros((1, 1)), np.full((1, 1), 20.0), np.zeros((1, 50, 0)))
    bare = Plant(model, ParameterSpace(model, []), nthread=1).shoot(np.zeros((1, 0)), segments)
    with_it = Plant(model, ParameterSpace(model, []), [feather(model)], nthread=1).shoot(np.zeros((1, 2)), segments)
    np.testing.assert_array_equal(bare.qpos, with_it.qpos)
