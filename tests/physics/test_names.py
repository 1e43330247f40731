"""What has no name gets one: of its joint, else of its kind and number, and no other's."""

import mujoco
import numpy as np
import pytest

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects import Scales, build, propose
from nfc_gym.physics.names import name_all, names

MJCF = """
<mujoco>
  <worldbody>
    <body name="joint_0"><joint name="hinge"/><geom size="0.1"/>
      <body><joint/><geom size="0.1"/><body name="body_2"><joint/><geom size="0.1"/></body></body>
    </body>
  </worldbody>
  <actuator><motor joint="hinge"/><motor joint="hinge"/><motor name="given" joint="hinge"/></actuator>
  <sensor><jointpos joint="hinge"/></sensor>
</mujoco>
"""


def test_each_gets_a_name_of_its_own() -> None:
    model = mujoco.MjModel.from_xml_string(MJCF)
    called = names(model)
    assert called.actuators == ["hinge", "actuator_1", "given"]
    assert called.joints == ["hinge", "joint_1", "joint_2"]
    assert called.bodies == ["world", "joint_0", "body_2_", "body_2"]
    assert called.sensors == ["sensor_0"]


def test_a_model_in_which_all_are_named_is_called_the_same() -> None:
    spec = mujoco.MjSpec.from_string(MJCF)
    before = names(spec.copy().compile())
    after = mujoco.MjModel.from_xml_string(name_all(spec).to_xml())
    assert names(after) == before
    assert mujoco.mj_id2name(after, mujoco.mjtObj.mjOBJ_BODY, 2) == "body_2_"
    assert mujoco.mj_id2name(after, mujoco.mjtObj.mjOBJ_ACTUATOR, 0) == "hinge"


WIDE = """
<mujoco>
  <worldbody>
    <body><joint name="ball" type="ball"/><geom size="0.1"/></body>
    <body><joint name="hinge"/><geom size="0.1"/></body>
  </worldbody>
  <actuator>
    <orientation name="turn" joint="ball" kp="1"/><motor name="push" joint="hinge" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""


def test_actuators_of_several_commands_are_told() -> None:
    """A command is then in another column than its actuator's id says; joints have their effects all the same."""
    model = mujoco.MjModel.from_xml_string(WIDE)
    assert (model.nu, model.nactuator) == (4, 2)
    assert names(model).actuators == ["turn", "push"]
    for family, parameters in (("delay", {"delay": 0.01}), ("gain", {"gain": 0.5}), ("offset", {"offset": 0.1})):
        with pytest.raises(InputError, match="one command and one force of each, and turn of this model has more"):
            build(family, "push", parameters)[0].bind(model)
    ones = [np.ones(n) for n in (model.nv, model.nv, model.nu, model.nu)]
    found = propose(model, Scales(*ones, 0.01, {"exo:supply": 12.0, "exo:time": 1.0}))
    for effect in found:
        effect.bind(model)
    assert {"coulomb:hinge", "armature:hinge"} <= {e.id for e in found}
    assert not {"turn", "push"} & {place for e in found for place in e.where}
