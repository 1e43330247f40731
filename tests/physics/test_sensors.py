"""Faulty sensors: what they report of a known motion, and the start state recovered from it."""

import mujoco
import numpy as np
import pytest
from machines import make

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.saved import from_row
from nfc_gym.physics.effects.sensors import Place, resolve_channel, true_state, unit_of
from nfc_gym.physics.state import quat_conjugate, quat_multiply, quat_to_vector, rotate_back, vector_to_quat

MODEL = mujoco.MjModel.from_xml_string("""
<mujoco><worldbody><body name="base"><freejoint/><geom size=".1"/><site name="imu"/></body>
<body><joint name="arm" axis="0 0 1"/><geom size=".1"/></body></worldbody>
<sensor><gyro name="gyro" site="imu"/></sensor></mujoco>""")
DT = 0.01
RNG = np.random.default_rng(3)


def _bound(family: str, channel: str, parameters: dict[str, float]) -> tuple:
    effect, theta = make(family, channel, parameters)
    effect.bind(MODEL)
    return effect, theta


def test_bias_and_gain_are_affine() -> None:
    values = RNG.normal(size=(4, 20, 1))
    effect, theta = _bound("sensor_bias", "joint:arm:pos", {"bias": 0.3})
    np.testing.assert_allclose(effect.sense("joint:arm:pos", values, theta, DT), values + 0.3)
    np.testing.assert_array_equal(effect.sense("joint:arm:vel", values, theta, DT), values)
    effect, theta = _bound("sensor_gain", "joint:arm:pos", {"gain": 1.2})
    np.testing.assert_allclose(effect.sense("joint:arm:pos", values, theta, DT), 1.2 * values)
    effect, theta = _bound("sensor_bias", "sensor:gyro", {"x": 0.1, "y": 0.2, "z": 0.3})
    three = RNG.normal(size=(4, 20, 3))
    np.testing.assert_allclose(effect.sense("sensor:gyro", three, theta, DT), three + np.array([0.1, 0.2, 0.3]))


def test_names_may_hold_colons() -> None:
    """As of gymnasium-robotics' Fetch, `robot0:torso_lift_joint`."""
    model = mujoco.MjModel.from_xml_string("""
<mujoco><worldbody><body name="r:base"><freejoint/><geom size=".1"/><site name="imu"/></body>
<body><joint name="r:lift" type="slide"/><geom size=".1"/></body></worldbody>
<sensor><gyro name="r:gyro" site="imu"/></sensor>
<actuator><motor name="r:motor" joint="r:lift"/></actuator></mujoco>""")
    assert resolve_channel(model, "joint:r:lift:vel") == Place("joint", "vel", 1, 7, 6)
    assert resolve_channel(model, "body:r:base:angvel@body") == Place("body", "angvel@body", 3, 0, 0)
    assert resolve_channel(model, "sensor:r:gyro").dim == 3
    assert resolve_channel(model, "force:r:motor").dim == 1
    assert unit_of(model, "joint:r:lift:vel") == "m/s"


@pytest.mark.parametrize(
    ("channel", "unit"),
    [
        ("joint:arm:pos", "rad"),
        ("joint:arm:vel", "rad/s"),
        ("joint:lift:pos", "m"),
        ("joint:lift:acc", "m/s^2"),
        ("body:base:linvel", "m/s"),
        ("body:base:angvel@body", "rad/s"),
        ("sensor:gyro", "1"),
    ],
)
def test_a_bias_has_the_unit_of_its_channel(channel: str, unit: str) -> None:
    model = mujoco.MjModel.from_xml_string(
        """
<mujoco><worldbody><body name="base"><freejoint/><geom size=".1"/><site name="imu"/></body>
<body><joint name="arm"/><geom size=".1"/></body><body><joint name="lift" type="slide"/><geom size=".1"/></body>
</worldbody><sensor><gyro name="gyro" site="imu"/></sensor></mujoco>"""
    )
    assert unit_of(model, channel) == unit


def test_delay_reports_the_past_exactly_for_straight_lines() -> None:
    """A line is reported late without error at any delay, the extrapolated beginning included."""
    time = np.arange(30) * DT
    line = (0.5 + 2 * time)[None, :, None]
    for delay in (0.0, 0.004, 0.03):
        effect, theta = _bound("sensor_delay", "joint:arm:pos", {"delay": delay})
        np.testing.assert_allclose(
            effect.sense("joint:arm:pos", line, theta[None], DT)[0, :, 0], 0.5 + 2 * (time - delay), atol=1e-12
        )


def test_delay_of_whole_samples_shifts_bit_for_bit() -> None:
    values = RNG.normal(size=(2, 30, 3))
    effect, _ = _bound("sensor_delay", "sensor:gyro", {"delay": 0.0})
    late = effect.sense("sensor:gyro", values, np.array([[0.0], [4.0]]), 1.0)
    np.testing.assert_array_equal(late[0], values[0])
    np.testing.assert_array_equal(late[1, 4:], values[1, :-4])


@pytest.mark.parametrize(
    ("family", "channel", "parameters"),
    [
        ("sensor_bias", "joint:arm:pos", {"bias": 0.3}),
        ("sensor_bias", "joint:arm:vel", {"bias": 0.3}),
        ("sensor_bias", "body:base:linvel", {"x": 0.1, "y": 0.2, "z": 0.3}),
        ("sensor_bias", "body:base:angvel@body", {"x": 0.1, "y": 0.2, "z": 0.3}),
        ("sensor_gain", "joint:arm:pos", {"gain": 1.2}),
        ("sensor_gain", "joint:arm:vel", {"gain": 1.2}),
        ("sensor_gain", "body:base:linvel", {"gain": 1.2}),
        ("misalignment", "body:base:quat", {"x": 0.2, "y": -0.1, "z": 0.3}),
        ("misalignment", "body:base:linvel", {"x": 0.2, "y": -0.1, "z": 0.3}),
    ],
)
def test_unsense_recovers_the_start_state(family: str, channel: str, parameters: dict[str, float]) -> None:
    q, v = RNG.normal(size=(5, MODEL.nq)), RNG.normal(size=(5, MODEL.nv))
    q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    where = {"joint:arm:pos": (q, 7, 1), "joint:arm:vel": (v, 6, 1), "body:base:linvel": (v, 0, 3)}
    where |= {"body:base:angvel@body": (v, 3, 3), "body:base:quat": (q, 3, 4)}
    array, at, dim = where[channel]
    effect, theta = _bound(family, channel, parameters)
    wrong_q, wrong_v = q.copy(), v.copy()
    wrong = wrong_q if array is q else wrong_v
    wrong[:, at : at + dim] = effect.sense(channel, array[:, None, at : at + dim], theta, DT)[:, 0]
    if (family, channel) == ("sensor_gain", "joint:arm:pos"):
        wrong_v[:, 6] *= 1.2  # speed taken from the same channel
    if channel == "body:base:quat":
        wrong_v[:, 3:6] = rotate_back(vector_to_quat(theta)[None], v[:, 3:6])  # and so are rates, in the mount's frame
    back_q, back_v = effect.unsense(wrong_q, wrong_v, theta)
    np.testing.assert_allclose(back_q, q, atol=1e-12)
    np.testing.assert_allclose(back_v, v, atol=1e-12)
    assert not np.allclose(wrong, array)


def test_delay_moves_the_start_state_on() -> None:
    effect, theta = _bound("sensor_delay", "joint:arm:pos", {"delay": 0.05})
    q, v = np.zeros((1, MODEL.nq)), np.full((1, MODEL.nv), 2.0)
    assert effect.unsense(q, v, theta)[0][0, 7] == pytest.approx(0.1)
    effect, theta = _bound("sensor_delay", "body:base:quat", {"delay": 0.05})
    q[:, 3] = 1.0
    np.testing.assert_allclose(quat_to_vector(effect.unsense(q, v, theta)[0][0, 3:7]), [0.1, 0.1, 0.1], atol=1e-12)


def test_misalignment_turns_vectors_and_orientations_alike() -> None:
    """The world's direction of a measured vector is the same whether sensed or true: R_meas a_meas = R a."""
    mount = {"x": 0.2, "y": -0.1, "z": 0.3}
    vector, theta = _bound("misalignment", "sensor:gyro", mount)
    orientation, _ = _bound("misalignment", "body:base:quat", mount)
    quat, a = vector_to_quat(RNG.normal(size=(1, 3))), RNG.normal(size=(1, 3))
    seen_quat = orientation.sense("body:base:quat", quat, theta, DT)
    seen = vector.sense("sensor:gyro", a, theta, DT)
    turn = lambda q, x: quat_multiply(quat_multiply(q, np.c_[[0.0], x]), quat_conjugate(q))[:, 1:]  # noqa: E731
    np.testing.assert_allclose(turn(seen_quat, seen), turn(quat, a), atol=1e-12)
    assert np.linalg.norm(seen - a) > 0.01


def test_values_for_each_channel_act_on_their_own() -> None:
    """Of one family at two channels, each with a value of its own."""
    joined, theta = from_row(
        {
            "family": "sensor_bias",
            "where": ["joint:arm:pos", "joint:arm:vel"],
            "each": True,
            "parameters": {"bias@joint:arm:pos": 0.3, "bias@joint:arm:vel": -0.2},
        }
    )
    joined.bind(MODEL)
    zero = np.zeros((5, 1))
    np.testing.assert_allclose(joined.sense("joint:arm:pos", zero, theta, DT), 0.3)
    np.testing.assert_allclose(joined.sense("joint:arm:vel", zero, theta, DT), -0.2)
    q, v = true_state([joined], [theta], np.zeros(MODEL.nq), np.zeros(MODEL.nv))
    assert (q[7], v[6]) == (pytest.approx(-0.3), pytest.approx(0.2))


@pytest.mark.parametrize(
    ("family", "channel", "parameters"),
    [
        ("sensor_bias", "joint:arm:pos", {"x": 0.1, "y": 0.2, "z": 0.3}),
        ("sensor_bias", "body:base:quat", {"bias": 0.1}),
        ("sensor_gain", "body:base:quat", {"gain": 1.1}),
        ("misalignment", "joint:arm:pos", {"x": 0.1, "y": 0.2, "z": 0.3}),
    ],
)
def test_faults_that_a_channel_cannot_have_are_refused(family: str, channel: str, parameters: dict[str, float]) -> None:
    with pytest.raises(InputError, match=f"{family} of '{channel}' .*; want"):
        _bound(family, channel, parameters)


def test_unknown_channels_are_refused() -> None:
    for channel in ("joint:leg:pos", "sensor:nose", "body:tail:pos", "smell:rose"):
        parameters = {"delay": 0.1}
        with pytest.raises(InputError):
            _bound("sensor_delay", channel, parameters)
