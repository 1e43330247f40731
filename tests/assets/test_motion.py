"""The Jackal rolls and skid-steers, the Quadcopter hovers, the Quadruped stands; all over their whole prior."""

import tomllib
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from nfc_gym import assets

RADIUS, TRACK, WHEELBASE = 0.098, 0.37559, 0.262  # m
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
GRAVITY = 9.81
# Highest root, m, under random commands: the weight never leaves the ground by more than the drop and a hop.
CEILING = {"ant": 0.8, "humanoid": 1.5, "jackal": 0.6, "quadruped": 0.6}
SPAN = {"ant": 1.0, "humanoid": 1.0, "jackal": 2.0 / RADIUS, "quadruped": 0.25}


def load(robot: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The robot at rest in its keyframe."""
    model = mujoco.MjModel.from_xml_path(str(assets.path(robot)))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    return model, data


def read(file: str) -> dict[str, Any]:
    """A data file of the assets' folder."""
    return tomllib.loads((assets.path("jackal").parents[1] / file).read_text())


def drive(forward: float, yaw: float) -> tuple[mujoco.MjData, NDArray[np.float64]]:
    """Two seconds to settle, then two more of base velocity (t, 6) and wheel speed (t, 4), side by side."""
    model, data = load("jackal")
    left, right = ((forward + s * yaw * TRACK / 2) / RADIUS for s in (-1, 1))
    data.ctrl[:] = left, right, left, right
    mujoco.mj_step(model, data, nstep=400)
    rows = []
    for _ in range(400):
        mujoco.mj_step(model, data)
        rows.append(np.concatenate([data.sensor("imu_velocity").data, data.sensor("imu_gyro").data, data.qvel[6:]]))
    return data, np.array(rows)


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0, -1.0])
def test_jackal_rolls_without_slip(speed: float) -> None:
    data, rows = drive(speed, 0.0)
    mean = rows.mean(axis=0)
    np.testing.assert_allclose(mean[0], RADIUS * mean[6:], rtol=0.02)
    assert mean[0] == pytest.approx(speed, rel=0.02)
    assert abs(data.qpos[1]) < 1e-3
    assert np.abs(rows[:, 3:6]).max() < 1e-3


@pytest.mark.parametrize("yaw", [1.0, 2.0, 4.0, -4.0])
def test_skid_steering_turns_as_coulomb_friction_says(yaw: float) -> None:
    """On the spot, friction opposes slip at each wheel, so longitudinal over lateral slip is wheelbase over track.

    With w the wheel's speed: r w - yaw track / 2 = (wheelbase / track) (yaw wheelbase / 2), which fixes yaw for any
    friction.
    """
    _, rows = drive(0.0, yaw)
    mean = rows.mean(axis=0)
    rim = RADIUS * (mean[7] - mean[6] + mean[9] - mean[8]) / 4
    ideal = rim / (TRACK / 2 + WHEELBASE**2 / (2 * TRACK))
    assert mean[5] == pytest.approx(ideal, rel=0.05)
    assert 0.5 * abs(yaw) < abs(mean[5]) < abs(yaw)


def test_friction_of_the_wheel_holds_not_the_grounds() -> None:
    """Wheels at 0.1 on ground at 1.0, commanded to full speed from rest, cannot accelerate faster than 0.1 g."""
    model, data = load("jackal")
    for wheel in WHEELS:
        model.geom(f"{wheel}_wheel").friction[0] = 0.1
    data.ctrl[:] = 2.0 / RADIUS
    mujoco.mj_step(model, data, nstep=100)
    assert data.qvel[0] / 0.5 == pytest.approx(0.1 * GRAVITY, rel=0.1)


def test_a_lost_axle_pulls_to_its_side() -> None:
    """With no drive at the front left wheel, equal commands make the robot veer left."""
    model, data = load("jackal")
    model.actuator("front_left").gainprm[0] = model.actuator("front_left").biasprm[2] = 0.0
    data.ctrl[:] = 1.0 / RADIUS
    mujoco.mj_step(model, data, nstep=40)
    assert data.actuator("front_left").force[0] == 0.0
    assert data.qvel[5] > 1e-3


def test_one_contact_a_wheel_on_flat_ground() -> None:
    model, data = load("jackal")
    mujoco.mj_forward(model, data)
    touching = sorted(model.geom(g).name for c in data.contact for g in c.geom if model.geom(g).name != "ground")
    assert touching == sorted(f"{w}_wheel" for w in WHEELS)


def test_hover_thrust_keeps_altitude_and_maximum_is_twice_the_weight() -> None:
    model, data = load("quadcopter")
    weight = model.body_mass.sum() * GRAVITY
    assert model.actuator_ctrlrange[:, 1].sum() == pytest.approx(2 * weight, rel=1e-3)
    # The arms bend, so the rotors tilt outwards or inwards and hover takes a little more than the weight.
    assert 1.0 <= data.ctrl.sum() / weight < 1.01
    height = data.qpos[2]
    mujoco.mj_step(model, data, nstep=1000)
    assert data.qpos[2] == pytest.approx(height, abs=1e-3)


def test_motor_is_first_order() -> None:
    """From rest, thrust follows T (1 - exp(-t / tau)) exactly at the steps, tau being 0.05 s."""
    model, data = load("quadcopter")
    data.act[:] = 0.0
    data.ctrl[:] = 3.0
    mujoco.mj_step(model, data, nstep=10)
    np.testing.assert_allclose(data.act, 3.0 * (1 - np.exp(-0.05 / 0.05)), rtol=1e-9)


@pytest.mark.parametrize(("axis", "signs"), [(3, (1, -1, 1, -1)), (4, (-1, -1, 1, 1)), (5, (-1, 1, 1, -1))])
def test_rotors_turn_the_quadcopter_the_expected_way(axis: int, signs: tuple[int, ...]) -> None:
    """More thrust left rolls right (+x), at the rear pitches down (+y), on the rotors that push left yaws left (+z)."""
    model, data = load("quadcopter")
    data.ctrl[:] = data.ctrl + 0.2 * np.array(signs)
    mujoco.mj_step(model, data, nstep=20)
    rates = data.qvel[3:6]
    assert rates[axis - 3] > 0
    assert abs(rates[axis - 3]) > 20 * np.abs(np.delete(rates, axis - 3)).max()


def test_feet_carry_the_quadruped() -> None:
    model, data = load("quadruped")
    mujoco.mj_forward(model, data)
    touch = [data.sensor(f"{leg}_foot_touch").data[0] for leg in ("FL", "FR", "RL", "RR")]
    assert sum(touch) == pytest.approx(12.0 * GRAVITY, rel=1e-3)
    assert min(touch) > 20
    assert np.abs(data.ctrl - data.qpos[7:]).max() < 0.2
    force = [np.linalg.norm(data.sensor(f"{leg}_foot_force").data) for leg in ("FL", "FR", "RL", "RR")]
    np.testing.assert_allclose(force, np.array(touch) - model.body("FL_foot").mass * GRAVITY, rtol=1e-3)


def set_psi(model: mujoco.MjModel, robot: str, generator: np.random.Generator) -> None:
    """A uniform draw from the prior, written with mass moving inertia."""
    table = read("restitution.toml")
    for p in read(f"{robot}/psi.toml")["parameter"]:
        value = generator.uniform(p["low"], p["high"])
        for name in p["of"]:
            match p["field"]:
                case "body_mass":
                    model.body(name).inertia[:] *= value / model.body(name).mass[0]
                    model.body(name).mass[0] = value
                case "servo_kv":
                    model.actuator(name).gainprm[0], model.actuator(name).biasprm[2] = value, -value
                case "servo_kp":
                    model.actuator(name).gainprm[0], model.actuator(name).biasprm[1] = value, -value
                case "geom_friction[0]":
                    model.geom(name).friction[0] = value
                case "geom_restitution":
                    zeta = np.interp(value, table["restitution"], table["zeta"])
                    model.geom(name).solref[:] = -(table["omega"] ** 2), -2 * zeta * table["omega"]
                case "jnt_stiffness":
                    model.joint(name).stiffness[0] = value
                case field:
                    raise AssertionError(field)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("robot", assets.ROBOTS)
def test_stable_over_the_prior_under_random_actions(robot: str, seed: int) -> None:
    """Two seconds of fresh random commands at 50 Hz, from a small drop: finite, no warning, no energy from nowhere."""
    generator = np.random.default_rng(seed)
    model, data = load(robot)
    set_psi(model, robot, generator)
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[2] += 0.1
    centre = data.ctrl.copy()
    for _ in range(100):
        action = generator.uniform(-1, 1, model.nu)
        data.ctrl[:] = (action + 1) / 2 * 4.905 if robot == "quadcopter" else centre + SPAN[robot] * action
        mujoco.mj_step(model, data, nstep=4)
        assert np.isfinite(data.qpos).all()
        assert np.isfinite(data.qvel).all()
        if robot != "quadcopter":
            assert data.qpos[2] < CEILING[robot]
            assert np.abs(data.qvel[:3]).max() < 5.0
    assert not any(w.number for w in data.warning)
    assert np.abs(data.qvel[:3]).max() < 30.0
