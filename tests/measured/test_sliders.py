"""Bodies that only slide: roll-outs move as the model does that was given, and their masses may change."""

import mujoco
import numpy as np
import pytest

from nfc_gym.measured.model import bare, compile_model
from nfc_gym.physics.effects import build, complete_inertia
from nfc_gym.physics.parameters import ParameterSpace
from nfc_gym.physics.rollout import Plant
from nfc_gym.physics.segments import Segments

GRIPPER = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body name="left" pos="-.05 0 0"><joint name="l" type="slide" axis="1 0 0" damping="6" armature=".25"/>
 <geom name="pad" type="box" size=".008 .012 .03" mass=".06"/></body>
<body name="right" pos=".05 0 0"><joint name="r" type="slide" axis="-1 0 0" damping="6"/>
 <geom type="box" size=".008 .012 .03" mass=".06"/></body>
<body name="block"><joint name="b" type="slide" axis="1 0 0" stiffness="60" damping="2"/>
 <geom type="box" size=".018 .012 .02" mass=".05" solref="-900 -25"/></body></worldbody>
<equality><joint joint1="r" joint2="l" solref=".006 1"/></equality>
<actuator><position name="grip" joint="l" kp="400" kv="12"/></actuator></mujoco>"""
GOALS = 0.03 * np.ones((1, 200, 1))


def completed() -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(GRIPPER)
    complete_inertia(spec)
    return compile_model(bare(spec), "gripper")


def alone(model: mujoco.MjModel) -> np.ndarray:
    data = mujoco.MjData(model)
    rows = [data.qpos.copy()]
    for u in GOALS[0]:
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
        rows.append(data.qpos.copy())
    return np.array(rows)


def rolled(**load: float) -> np.ndarray:
    """Where a roll-out goes, with a load on the left jaw or without one."""
    laws = [build("payload", "left", load)] if load else []
    plant = Plant(completed(), ParameterSpace(completed(), []), [law for law, _ in laws], nthread=1)
    segments = Segments(0.002, 0, np.zeros((1, 3)), np.zeros((1, 3)), GOALS)
    return plant.shoot(np.concatenate([np.zeros(0), *(theta for _, theta in laws)])[None], segments).qpos[0, 0]


def test_coupled_jaws_that_close_on_a_block_move_as_in_plain_mujoco() -> None:
    """What couples and touches is as hard as in the model: without its short cut the block gave way by half as much."""
    given = alone(mujoco.MjModel.from_xml_string(GRIPPER))
    assert given[-1, 0] > 0.0245  # the pads have pressed into the block
    np.testing.assert_allclose(rolled(), given, atol=1e-12)


@pytest.mark.parametrize("place", [0.0, 0.05])
def test_a_load_on_a_body_that_slides_is_a_heavier_body(place: float) -> None:
    """Wherever on it the load is."""
    heavier = GRIPPER.replace('mass=".06"/></body>\n<body name="right"', 'mass=".16"/></body>\n<body name="right"')
    assert heavier != GRIPPER
    found = rolled(mass=0.1, x=place, y=0.0, z=-place)
    np.testing.assert_allclose(found, alone(mujoco.MjModel.from_xml_string(heavier)), atol=1e-9)
    assert np.abs(found - rolled()).max() > 1e-4
