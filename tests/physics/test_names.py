"""What has no name gets one: of its joint, else of its kind and number, and no other's."""

import mujoco

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
