"""The Humanoid's laws against numbers worked out by hand; what it shares with the Ant is tested in `test_runner.py`."""

import mujoco
import numpy as np
import pytest
from views import blank, level, proprio, robot_of, view_of

from nfc_gym.envs.humanoid import Humanoid
from nfc_gym.envs.robot import DT

ROBOT, MODEL = robot_of(Humanoid)
HALF = np.sqrt(0.5)


def test_every_entry_of_proprio() -> None:
    """Facing -x, pitched by nothing; the target half right ahead; every entry a number of its own."""
    fields = blank(MODEL)
    fields["qpos"][:7] = [1, 1, 1.5, 0, 0, 0, 1]
    fields["qpos"][7:] = 0.01 * np.arange(21)
    fields["qvel"][:] = [1, 2, 3, 0.1, 0.2, 0.3, *(100 + np.arange(21))]
    fields["qfrc_actuator"][:] = [0, 0, 0, 0, 0, 0, *(200 + np.arange(21))]
    fields["sensordata"][:] = 300 + np.arange(MODEL.nsensordata)
    task = {"target": np.array([0.0, 2.0]), "action": 0.001 * np.arange(21)}
    view = view_of(ROBOT, MODEL, fields, task, level(0.25))
    expected = [
        1.25,
        *(-1, -2, 3),
        *(0.1, 0.2, 0.3),
        *(np.pi, 0, -np.pi / 4),
        *(1, HALF),
        *(0.01 * np.arange(21)),
        *(100 + np.arange(21)),
        *(200 + np.arange(21)),
        *range(313, 325),
        *(0.001 * np.arange(21)),
    ]
    np.testing.assert_allclose(proprio(ROBOT, view), expected, atol=1e-12)
    assert len(expected) == ROBOT.proprio_size == 108


def test_pitched_robot() -> None:
    """Leaning 0.4 rad forward: no roll, and the forward axis points down by as much."""
    fields = blank(MODEL)
    fields["qpos"][:7] = [0, 0, 1, np.cos(0.2), 0, np.sin(0.2), 0]
    fields["qvel"][2] = -1.0
    task = {"target": np.array([9.0, 0.0]), "action": np.zeros(21)}
    entries = proprio(ROBOT, view_of(ROBOT, MODEL, fields, task))
    expected = [1, np.sin(0.4), 0, -np.cos(0.4), 0, 0, 0, 0, 0, 0, np.cos(0.4), np.cos(0.4)]
    np.testing.assert_allclose(entries[:12], expected, atol=1e-12)


def test_torques_are_those_at_the_joints() -> None:
    data = mujoco.MjData(MODEL)
    data.ctrl[:] = np.linspace(-1, 1, 21)
    mujoco.mj_forward(MODEL, data)
    np.testing.assert_allclose(data.qfrc_actuator[6:], ROBOT.gear * data.ctrl)
    assert {name: MODEL.actuator(name).gear[0] for name in ("abdomen_z", "right_hip_y", "left_ankle_x")} == {
        "abdomen_z": 67.5,
        "right_hip_y": 135.0,
        "left_ankle_x": 22.5,
    }


def test_every_term_of_the_reward() -> None:
    """Backwards at 0.5 m/s while facing the target, leaning; a knee at its stop; torque on the left hip."""
    task = {"target": np.array([9.0, 0.0]), "action": np.zeros(21)}
    before = view_of(ROBOT, MODEL, blank(MODEL), task).now
    fields = blank(MODEL)
    fields["qpos"][0] = -0.5 * DT
    fields["qpos"][3:7] = [np.cos(0.2), 0, np.sin(0.2), 0]
    fields["qpos"][7:] = (ROBOT.low + ROBOT.high) / 2
    fields["qpos"][MODEL.joint("left_knee").qposadr[0]] = -0.03
    hip = MODEL.actuator("left_hip_y").id
    fields["qvel"][MODEL.joint("left_hip_y").dofadr[0]] = 2.0
    fields["ctrl"][hip] = -0.2
    action = np.zeros(21)
    action[hip] = -0.2
    view = view_of(ROBOT, MODEL, fields, task)
    view.before = before
    terms = ROBOT.reward(view, action)
    expected = {
        "progress": -0.5,
        "alive": 1.0,
        "upright": 0.1 * np.cos(0.4),
        "heading": 0.5,
        "action": -0.01 * 0.04,
        "energy": -0.0002 * 0.2 * 135 * 2,
        "limits": -0.25,
    }
    assert tuple(terms) == ROBOT.terms == tuple(expected)
    for name, value in expected.items():
        assert terms[name] == pytest.approx(value, abs=1e-9), name


@pytest.mark.parametrize(("height", "ended"), [(1.27, False), (0.81, False), (0.79, True)])
def test_ends_when_the_torso_is_down(height: float, ended: bool) -> None:
    fields = blank(MODEL)
    fields["qpos"][2] = height + 0.5
    task = {"target": np.array([9.0, 0.0]), "action": np.zeros(21)}
    assert ROBOT.terminated(view_of(ROBOT, MODEL, fields, task, level(0.5))) == ended
