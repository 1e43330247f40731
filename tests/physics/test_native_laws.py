"""Laws that MuJoCo's `dcmotor` has too: docs/library.md says which of them are the same, and which are not."""

import mujoco
import numpy as np
import pytest

from nfc_gym.physics.effects.hysteresis import dahl

STEP = 5e-4
MODEL = """<mujoco><option timestep="{step}" gravity="0 0 0"/>
<worldbody><body><joint name="hinge" axis="0 1 0"/><geom size="0.1" mass="1e6"/></body></worldbody>
<actuator><motor joint="hinge"/><dcmotor joint="hinge" {of}/></actuator></mujoco>"""
PASSIVE = 'input="none" motorconst="0 0" resistance="1" '


def made(of: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(MODEL.format(step=STEP, of=of))
    return model, mujoco.MjData(model)


@pytest.mark.parametrize("order", [6.0, 2.5])
def test_its_cogging_is_the_effects_torque_and_one_more_actuator_without_a_command(order: float) -> None:
    model, data = made(f'{PASSIVE} cogging="0.1 {order} 0.3"')
    assert (model.nu, model.nactuator) == (1, 2)
    for angle in np.linspace(-2, 2, 9):
        data.qpos[:] = angle
        mujoco.mj_forward(model, data)
        ours = 0.1 * np.cos(0.3) * np.sin(order * angle) + 0.1 * np.sin(0.3) * np.cos(order * angle)
        assert data.qfrc_actuator[0] == pytest.approx(ours, abs=1e-12)


def test_its_lugre_friction_without_damping_and_without_stribecks_rise_is_dahls_hysteresis() -> None:
    model, data = made(f'{PASSIVE} lugre="10 0 0.1 0.1 1"')
    state, most = np.zeros(()), 0.0
    for k in range(4000):
        speed = 0.05 * np.cos(2 * np.pi * k * STEP / 0.8)
        data.qvel[:] = speed
        mujoco.mj_step(model, data)
        state = dahl(state, np.asarray(speed * STEP), np.asarray(0.1 / 10))
        assert 10 * data.act[0] == pytest.approx(0.1 * float(state), abs=1e-12)
        most = max(most, float(state))
    assert 0.4 < most < 1.0


def test_its_voltage_limit_is_a_torque_that_falls_with_speed_and_grows_in_braking() -> None:
    model, data = made('input="ff" motorconst="0.1 0.1" resistance="1" controller="0 0 0 0 0 10"')
    data.ctrl[1] = 5.0  # N m, far beyond 1 N m that it makes at rest; its no-load speed is 100 rad/s
    for speed in (0.0, 50.0, 90.0, -50.0):
        data.qvel[:] = speed
        mujoco.mj_forward(model, data)
        assert data.qfrc_actuator[0] == pytest.approx(1 - speed / 100, abs=1e-12)
