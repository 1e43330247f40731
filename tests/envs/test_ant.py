"""The Ant's laws against numbers worked out by hand; what it shares with the Humanoid is tested in `test_runner.py`."""

import mujoco
import numpy as np
import pytest
from views import blank, level, proprio, robot_of, view_of

from nfc_gym.envs.ant import Ant
from nfc_gym.envs.robot import DT

ROBOT, MODEL = robot_of(Ant)
HALF = np.sqrt(0.5)


def turned_left() -> dict[str, np.ndarray]:
    """Facing +y at (2, 1, 0.5), moving at (1, 2, 3) in the world, rates (0.1, 0.2, 0.3) in its own frame."""
    fields = blank(MODEL)
    fields["qpos"][:] = [2, 1, 0.5, HALF, 0, 0, HALF, 0.1, 0.6, -0.1, 0.7, 0.2, 0.8, -0.2, 0.9]
    fields["qvel"][:] = [1, 2, 3, 0.1, 0.2, 0.3, 1, 2, 3, 4, 5, 6, 7, 8]
    fields["sensordata"][:] = np.arange(MODEL.nsensordata)
    return fields


def test_every_entry_of_proprio() -> None:
    """Target 3 m to the left of the robot, ground at 0.1 m."""
    view = view_of(ROBOT, MODEL, turned_left(), {"target": np.array([-1.0, 1.0])}, level(0.1))
    expected = [
        0.4,  # height above the ground
        *(2, -1, 3),  # forward is the world's y, left is its -x
        *(0.1, 0.2, 0.3),
        *(np.pi / 2, 0, np.pi / 2),  # yaw, roll, angle to the target
        *(1, 0),  # upright; the target lies square to the heading
        *(0.1, 0.6, -0.1, 0.7, 0.2, 0.8, -0.2, 0.9),
        *(1, 2, 3, 4, 5, 6, 7, 8),
        *range(13, 37),  # behind gyroscope 3, accelerometer 3, quaternion 4 and velocimeter 3
    ]
    np.testing.assert_allclose(proprio(ROBOT, view), expected, atol=1e-12)
    assert len(expected) == ROBOT.proprio_size == 52


def test_rolled_robot() -> None:
    """Rolled by 0.3 rad about its forward axis, heading for the target: roll and upright say so, nothing else does."""
    fields = blank(MODEL)
    fields["qpos"][:7] = [0, 0, 1, np.cos(0.15), np.sin(0.15), 0, 0]
    fields["qvel"][1] = 1.0
    entries = proprio(ROBOT, view_of(ROBOT, MODEL, fields, {"target": np.array([9.0, 0.0])}))
    np.testing.assert_allclose(entries[:12], [1, 0, np.cos(0.3), -np.sin(0.3), 0, 0, 0, 0, 0.3, 0, np.cos(0.3), 1])


def test_wrenches_are_those_of_the_feet_in_order() -> None:
    """A simulation at rest: each foot's force points up along the leg, and the four carry the robot."""
    data = mujoco.MjData(MODEL)
    mujoco.mj_resetDataKeyframe(MODEL, data, 0)
    mujoco.mj_forward(MODEL, data)
    entries = data.sensordata[ROBOT.wrenches].reshape(4, 2, 3)
    for foot, (force, torque) in zip(ROBOT.feet, entries, strict=True):
        np.testing.assert_array_equal(force, data.sensor(f"{foot}_force").data)
        np.testing.assert_array_equal(torque, data.sensor(f"{foot}_torque").data)
        assert np.linalg.norm(force) > 10


def test_every_term_of_the_reward() -> None:
    """One step of 0.04 m straight at the target, which is 2 m/s; half torque on the first joint alone."""
    before = view_of(ROBOT, MODEL, blank(MODEL), {"target": np.array([9.0, 0.0])}).now
    fields = blank(MODEL)
    fields["qpos"][:2] = [2.0 * DT, 0.3]  # the sideways part does not count
    fields["qpos"][7:] = [0, 1.135, 0, 1.135, 0, 1.135, 0, 1.75]  # mid-range, but for the last at its limit
    fields["qvel"][6] = -4.0
    fields["ctrl"][0] = 0.5
    view = view_of(ROBOT, MODEL, fields, {"target": np.array([9.0, 0.3])})
    view.before = before
    terms = ROBOT.reward(view, np.array([0.5, 0, 0, 0, 0, 0, 0, 0]))
    assert tuple(terms) == ROBOT.terms
    expected = {
        "progress": 2.0,
        "alive": 0.5,
        "upright": 0.1,
        "heading": 0.5,
        "action": -0.005 * 0.25,
        "energy": -0.0005 * 0.5 * 30 * 4,
        "limits": -0.05,
    }
    for name, value in expected.items():
        assert terms[name] == pytest.approx(value, abs=1e-9), name


@pytest.mark.parametrize(("height", "ended"), [(0.36, False), (0.27, False), (0.25, True)])
def test_ends_when_the_torso_is_down(height: float, ended: bool) -> None:
    """Whatever the world's height of the ground."""
    fields = blank(MODEL)
    fields["qpos"][2] = height - 1.5
    view = view_of(ROBOT, MODEL, fields, {"target": np.array([9.0, 0.0])}, level(-1.5))
    assert ROBOT.terminated(view) == ended


def test_actions_are_torques() -> None:
    """Full action on one joint of a floating robot: 30 N m there, and nothing elsewhere."""
    data = mujoco.MjData(MODEL)
    action = np.zeros(8)
    action[2] = 1.0
    data.ctrl[:] = ROBOT.actuate(action, view_of(ROBOT, MODEL, blank(MODEL), {"target": np.zeros(2)}))
    mujoco.mj_forward(MODEL, data)
    expected = np.zeros(MODEL.nv)
    expected[MODEL.joint("front_right_hip").dofadr[0]] = 30.0
    np.testing.assert_allclose(data.qfrc_actuator, expected)
