"""Servos too stiff for the physics step: where the check warns the step decides how a wheel grips, elsewhere not."""

import mujoco
import numpy as np
import pytest

from nfc_gym.measured.stiffness import MOST, stiff_joints, stiffness_findings

STEP = 0.004
CART = """
<mujoco>
  <option timestep="{step}" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="ground" type="plane" size="0 0 1"/>
    <body name="cart" pos="0 0 0.1">
      <joint name="ahead" type="slide" axis="1 0 0"/>
      <joint name="aside" type="slide" axis="0 1 0"/>
      <joint name="up" type="slide" axis="0 0 1"/>
      <geom type="box" size="0.1 0.1 0.02" mass="20" contype="0" conaffinity="0"/>
      <body name="wheel">
        <joint name="axle" axis="0 1 0" armature="{armature}"/>
        <geom type="sphere" size="0.1" mass="1" condim="3" priority="1" friction="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator><velocity joint="axle" kv="{kv}" gear="2"/></actuator>
</mujoco>
"""


def cart(armature: float, kv: float, step: float = STEP) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(CART.format(armature=armature, kv=kv, step=step))


def skid(armature: float, kv: float, step: float = STEP) -> np.ndarray:
    """Where the cart stops (x, y), m, that slides off at (2, 1) m/s with its wheel held still."""
    model = cart(armature, kv, step)
    data = mujoco.MjData(model)
    data.qvel[:2] = 2, 1
    for _ in range(round(1.0 / step)):
        mujoco.mj_step(model, data)
    return data.qpos[:2].copy()


def test_where_it_warns_the_step_decides_how_a_locked_wheel_slides_and_elsewhere_it_does_not() -> None:
    """A heavy wheel is led by its servo alone and slides like a block, which stops after v^2 / (2 mu g)."""
    block = np.array([2, 1]) * np.sqrt(5) / (2 * 0.5 * 9.81)
    heavy, light = (5.0, 100.0), (0.0, 10.0)
    assert not stiff_joints(cart(*heavy), STEP)
    np.testing.assert_allclose(skid(*heavy), block, rtol=0.02)
    np.testing.assert_allclose(skid(*heavy), skid(*heavy, STEP / 64), rtol=0.02)
    assert stiff_joints(cart(*light), STEP)
    assert skid(*light)[0] > 1.2 * skid(*light, STEP / 64)[0]


def test_inertia_over_damping_and_the_armature_that_would_take_a_step() -> None:
    """A sphere of 1 kg and 0.1 m turns with 0.004 kg m^2; a gear of 2 makes four times the servo's 10 N m s/rad."""
    (found,) = stiff_joints(cart(0.001, 10), STEP)
    assert (found.joint, found.slides) == ("axle", False)
    assert found.settles == pytest.approx(0.005 / 40)
    assert stiff_joints(cart(found.armature, 10), MOST * STEP) == []
    assert stiff_joints(cart(0.99 * found.armature - 0.004, 10), MOST * STEP) != []
    assert found.armature == pytest.approx(40 * STEP - 0.004)


def test_what_touches_nothing_may_be_as_stiff_as_it_likes() -> None:
    text = CART.format(armature=0, kv=10, step=STEP).replace('priority="1"', 'contype="0" conaffinity="0"')
    model = mujoco.MjModel.from_xml_string(text)
    assert stiff_joints(model, STEP) == []
    assert list(stiffness_findings(model, STEP)) == []


def test_a_finding_names_the_joint_and_says_what_would_do() -> None:
    (finding,) = stiffness_findings(cart(0, 10), STEP)
    assert finding.severity == "warning"
    assert all(word in finding.message for word in ("'axle'", "0.0001 s", f"{STEP:g} s"))
    assert "segments.timestep to 0.0001" in finding.advice
    assert stiff_joints(cart(0, 10), 0.0001) == []


def test_a_joint_that_damping_holds_is_to_be_taken_out() -> None:
    """No step and no armature would do for it: Gymnasium's Fetch holds the slides of its base at 1e11 N s/m."""
    model = mujoco.MjModel.from_xml_string(
        CART.format(armature=0, kv=10, step=STEP).replace('"ahead"', '"ahead" damping="1e11"')
    )
    model.geom_contype[1] = 1  # what rides on it touches too
    led, held = sorted(stiffness_findings(model, STEP), key=lambda f: "holds" in f.message)
    assert "'axle'" in led.message
    assert "'ahead'" not in led.message
    assert "'ahead'" in held.message
    assert "take the joint out" in held.advice
    assert "timestep" not in held.advice
