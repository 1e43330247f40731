"""In which unit a command is: a force where the model hands it on as it is, and its own where a gear stands between."""

import mujoco
import numpy as np
import pytest

from nfc_gym.physics.effects import Scales, propose
from nfc_gym.physics.effects.drive import command_unit


@pytest.mark.parametrize(
    ("actuator", "unit"),
    [
        ('<motor joint="rail"/>', "N"),
        ('<motor joint="rail" gear="5"/>', "1"),
        ('<motor joint="hinge"/>', "N m"),
        ('<motor joint="hinge" gear="100"/>', "1"),
        ('<position joint="rail" kp="3" gear="5"/>', "m"),
        ('<velocity joint="hinge" kv="3"/>', "rad/s"),
        ('<general joint="hinge" gainprm="0.12" biastype="affine" biasprm="0 0 -0.035"/>', "1"),
        ('<intvelocity joint="hinge" kp="10" kv="1" actrange="-2 2"/>', "rad/s"),
        ('<intvelocity joint="rail" kp="10" kv="1" actrange="-2 2"/>', "m/s"),
        ('<general joint="hinge" dyntype="integrator" actlimited="true" actrange="-1 1"/>', "N m/s"),
        ('<general joint="rail" gear="5" dyntype="integrator" actlimited="true" actrange="-1 1"/>', "1/s"),
        ('<general joint="hinge" dyntype="integrator" gainprm="3" biastype="affine" biasprm="0 0 -3"/>', "rad/s^2"),
        ('<position joint="hinge" kp="3" timeconst="0.1"/>', "rad"),
    ],
)
def test_the_unit_of_a_command(actuator: str, unit: str) -> None:
    body = "<body><joint name='{}' type='{}'/><geom size='.1'/></body>"
    bodies = body.format("rail", "slide") + body.format("hinge", "hinge")
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{bodies}</worldbody><actuator>{actuator}</actuator></mujoco>"
    )
    assert command_unit(model, 0) == unit


TENDONS = """
<mujoco><worldbody>
  <body name="a"><joint name="left" type="slide" axis="1 0 0"/><geom size=".1"/><site name="a"/></body>
  <body name="b" pos="1 0 0"><joint name="right" type="slide" axis="1 0 0"/><geom size=".1"/><site name="b"/></body>
  <body name="c" pos="2 0 0"><joint name="turn" axis="0 0 1"/><geom size=".1" pos=".2 0 0"/></body></worldbody>
<tendon>
  <fixed name="slides"><joint joint="left" coef="1"/><joint joint="right" coef="-1"/></fixed>
  <fixed name="turns"><joint joint="turn" coef="2"/></fixed>
  <fixed name="both"><joint joint="left" coef="1"/><joint joint="turn" coef="1"/></fixed>
  <spatial name="rope"><site site="a"/><site site="b"/></spatial></tendon>
<actuator><position {of} kp="10"/><velocity {of} kv="10"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("of", "position", "speed"),
    [
        ('joint="left"', "m", "m/s"),
        ('joint="turn"', "rad", "rad/s"),
        ('tendon="slides"', "m", "m/s"),
        ('tendon="rope"', "m", "m/s"),
        ('tendon="turns"', "rad", "rad/s"),
        ('tendon="both"', "1", "1"),
        ('site="a" refsite="b"', "1", "1"),
    ],
)
def test_a_servo_is_commanded_in_the_unit_of_what_it_moves(of: str, position: str, speed: str) -> None:
    text = TENDONS.format(of=of)
    if "refsite" in of:
        text = text.replace('<velocity site="a" refsite="b" kv="10"/>', '<velocity site="a" kv="10"/>')
    model = mujoco.MjModel.from_xml_string(text)
    assert [command_unit(model, i) for i in (0, 1)] == [position, speed]


def test_a_servo_that_integrates_its_command_is_given_a_speed() -> None:
    """A speed has a dead zone, a range that may be cut, and a unit apart from a goal's."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint name="j" axis="0 1 0"/><geom size=".1"/></body></worldbody><actuator>
        <intvelocity name="turn" joint="j" kp="10" kv="1" actrange="-2 2" ctrlrange="-1 1"/>
        <position name="goal" joint="j" kp="3" ctrlrange="-1 1"/></actuator></mujoco>"""
    )
    scales = Scales(np.ones(1), np.ones(1), np.ones(2), np.ones(2), 0.01)
    found = {e.id: e for e in propose(model, scales)}
    assert [found[f"offset:{name}"].params[0].unit for name in ("turn", "goal")] == ["rad/s", "rad"]
    assert found["saturation:turn"].params[0].name == "removed"
    assert "dead_zone:turn" in found
    assert not {"dead_zone:goal", "offset:turn+goal"} & found.keys()
