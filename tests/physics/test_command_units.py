"""In which unit a command is: a force where the model hands it on as it is, and its own where a gear stands between."""

import mujoco
import pytest

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
    ],
)
def test_the_unit_of_a_command(actuator: str, unit: str) -> None:
    body = "<body><joint name='{}' type='{}'/><geom size='.1'/></body>"
    bodies = body.format("rail", "slide") + body.format("hinge", "hinge")
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{bodies}</worldbody><actuator>{actuator}</actuator></mujoco>"
    )
    assert command_unit(model, 0) == unit
