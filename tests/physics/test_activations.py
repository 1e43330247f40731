"""States of actuators outside of a simulation, against MuJoCo's own."""

import mujoco
import numpy as np
import pytest
from machines import plant_of
from mujoco.batch import Batch

from nfc_gym.physics.activations import Activations
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.segments import Segments

DT = 0.002
ARM = f"""
<mujoco><option timestep="{DT}"/><worldbody><body>
<joint name="turn" axis="0 1 0" damping=".5"/><geom size=".1" mass="1" pos=".2 0 0"/></body></worldbody>
<actuator>{{0}}</actuator></mujoco>"""
SERVO = '<intvelocity name="drive" joint="turn" kp="50" kv="2" gear="2" actrange="-9 9"/>'


@pytest.mark.parametrize(
    "actuator",
    [
        '<general name="drive" joint="turn" dyntype="filterexact" dynprm=".3" actrange="-.3 .4" ctrlrange="-2 2"/>',
        '<general name="drive" joint="turn" dyntype="integrator" actrange="-.3 .4" ctrlrange="-2 2"/>',
        SERVO,
    ],
)
def test_states_go_as_in_a_simulation(actuator: str) -> None:
    model = mujoco.MjModel.from_xml_string(ARM.format(actuator))
    data, activations, act = mujoco.MjData(model), Activations(model, DT), np.zeros(1)
    for ctrl in np.repeat(np.random.default_rng(0).uniform(-3, 3, 40), 20):
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data)
        activations.advance(data.ctrl, act)
        np.testing.assert_allclose(act, data.act, atol=1e-12)


def test_what_has_settled_stays_and_an_integrator_does_not_settle() -> None:
    both = '<general joint="turn" dyntype="filter" dynprm=".3"/><general joint="turn" dyntype="integrator"/>'
    activations = Activations(mujoco.MjModel.from_xml_string(ARM.format(both)), DT)
    act = np.array([0.0, 0.7])
    activations.advance(np.array([2.0, 2.0]), act, settle=True)
    np.testing.assert_array_equal(act, [2.0, 0.7])


@pytest.mark.parametrize("kp", [50.0, 80.0])
def test_a_servos_target_is_where_its_joint_hangs_from_it(kp: float) -> None:
    """At a steady speed, against gravity and damping, with the stiffness that the simulation has."""
    model = mujoco.MjModel.from_xml_string(ARM.format(SERVO))
    batch = Batch(model, 3, 1)
    fields = ModelFields(batch, model)
    fields["actuator_gainprm"][1, 0, 0], fields["actuator_biasprm"][1, 0, 1] = kp, -kp
    fields.commit()
    angle, speed = 0.4, 0.7
    batch.qpos[...], batch.qvel[...] = angle, speed
    Activations(model, DT).begin(batch, fields)
    load = 0.5 * speed - 9.81 * 0.2 * np.cos(angle)  # N m that the drive must make, downward being positive
    for row, stiffness in enumerate((50.0, kp, 50.0)):
        expected = 2 * angle + (load / 2 + 2.0 * 2 * speed) / stiffness
        assert batch.act[row, 0] == pytest.approx(expected, rel=1e-6)


def test_an_integrator_without_a_servo_is_left_alone() -> None:
    model = mujoco.MjModel.from_xml_string(ARM.format('<general joint="turn" dyntype="integrator"/>'))
    batch = Batch(model, 1, 1)
    batch.act[...] = 0.3
    Activations(model, DT).begin(batch, ModelFields(batch, model))
    assert batch.act[0, 0] == 0.3


@pytest.mark.parametrize("history", [0, 100])
def test_a_roll_out_takes_an_integrating_servo_up_where_the_log_had_it(history: int) -> None:
    """In the middle of a log whose joint had been sent away from where it began."""
    model = mujoco.MjModel.from_xml_string(ARM.format(SERVO.replace('kp="50"', 'kp="400"')))
    data, seen, begin, steps = mujoco.MjData(model), [], 1000, 200
    ctrl = 1.5 * np.sin(np.arange(begin + steps) * DT)
    for u in ctrl:
        seen.append((data.qpos[0], data.qvel[0]))
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
    q, v = np.array(seen).T[:, begin, None, None]
    segments = Segments(DT, history, q, v, ctrl[None, begin - history :, None])
    rolled = plant_of(model).shoot(np.zeros((1, 0)), segments).qpos[0, 0, -1, 0]
    assert abs(q[0, 0]) > 0.3
    assert rolled == pytest.approx(data.qpos[0], abs=0.005)
