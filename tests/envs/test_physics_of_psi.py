"""psi given to an environment's reset does to the motion what a closed form says."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import nfc_gym  # noqa: F401 (registers the ids)

GRAVITY, DT = 9.81, 0.005
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")


def jackals(n: int) -> Any:
    return gymnasium.make_vec("nfc_gym/JackalFlat-v0", num_envs=n, context=["psi"], autoreset_mode="Disabled").unwrapped


def every_wheel(what: str, values: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{wheel}_wheel_{what}": values for wheel in WHEELS}


def roll(envs: Any, action: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (t, n, nq) and velocities (t, n, nv) before every physics step under a constant action."""
    q, v = [], []

    def note(env: Any) -> None:
        q.append(env.batch.qpos.copy())
        v.append(env.batch.qvel.copy())

    envs.substep_hooks[:] = [note]
    for _ in range(steps):
        envs.step(np.full(envs.action_space.shape, action))
    return np.array(q), np.array(v)


@pytest.mark.parametrize("stiffness", [2.0, 4.0, 9.0])
@pytest.mark.parametrize("mass", [0.07, 0.15])
def test_a_rotor_arm_swings_with_the_period_of_its_mass_and_stiffness(mass: float, stiffness: float) -> None:
    """In free fall, on a chassis too heavy to move, an arm is a torsion pendulum: I q'' = -k q - b q'."""
    env = gymnasium.make("nfc_gym/QuadcopterFlat-v0", context=["psi"]).unwrapped
    psi = {"base_mass": 1e7, "front_left_arm_mass": mass, "front_left_mount_stiffness": stiffness}
    env.reset(seed=0, options={"psi": psi})
    data, model = env.data, env.model
    joints = [model.joint(f"front_left_mount_{axis}") for axis in "xy"]
    data.act[:] = 0
    data.qpos[7:] = 0
    data.qpos[2] = 5.0
    amplitude = 0.02
    for joint, sign in zip(joints, (-1, 1), strict=True):  # about the horizontal axis across the arm
        data.qpos[joint.qposadr] = sign * amplitude / np.sqrt(2)
    angles = []
    env.substep_hooks.append(lambda e: angles.append(float(e.data.qpos[joints[1].qposadr[0]]) * np.sqrt(2)))
    for _ in range(12):
        env.step(-np.ones(4))

    # The arm of the MJCF: its centre of mass 0.066 m along x and y and 0.00975 m up; a slender rod about its end.
    inertia = (0.000133312 * mass / 0.1) + mass * (2 * 0.066**2 + 0.00975**2)
    damping = 0.05
    q, v, expected = amplitude, 0.0, []
    for _ in angles:
        expected.append(q)
        v = (v - DT * stiffness / inertia * q) / (1 + DT * damping / inertia)  # damping is taken implicitly
        q += DT * v
    np.testing.assert_allclose(angles, expected, atol=0.02 * amplitude)
    zeros = np.flatnonzero(np.diff(np.sign(angles)))
    exact = [t + angles[t] / (angles[t] - angles[t + 1]) for t in zeros[:2]]
    omega = np.sqrt(stiffness / inertia - (damping / 2 / inertia) ** 2)
    assert DT * (exact[1] - exact[0]) == pytest.approx(np.pi / omega, rel=omega * DT / 5), "first order in the step"


def test_bounces_have_the_height_of_their_restitution_and_never_gain_energy() -> None:
    """Flat drops at 2.2 m/s from eight phases of a step: the mean rebound is e within 0.05."""
    restitution, phases = np.array([0.1, 0.3, 0.5, 0.7, 0.8]), (np.arange(8) + 0.5) / 8
    e = np.repeat(restitution, len(phases))
    envs = jackals(len(e))
    envs.reset(seed=0, options={"psi": every_wheel("restitution", e)})
    touch, speed = envs.model.geom("front_left_wheel").size[0], 2.2
    envs.batch.qpos[:, 2] = touch + np.tile(phases, len(restitution)) * speed * DT + 1e-9
    envs.batch.qvel[:, 2] = -speed
    q, v = roll(envs, 0.0, 50)
    z, vz = q[..., 2], v[..., 2]
    # Per kg; the half-step term makes it constant along the integrator's free flight.
    energy = (vz - GRAVITY * DT / 2) ** 2 / 2 + GRAVITY * (z - touch)
    free = z > touch
    assert (energy[free] <= np.broadcast_to(energy[0], energy.shape)[free] * (1 + 1e-9)).all()
    rebound = np.zeros(len(e))
    for i in range(len(e)):
        touched = np.flatnonzero(~free[:, i])[0]
        left = np.flatnonzero(free[touched:, i] & (vz[touched:, i] > 0))
        if len(left):
            rebound[i] = np.sqrt(energy[touched + left[0], i] / energy[0, i])
    np.testing.assert_allclose(rebound.reshape(len(restitution), -1).mean(1), restitution, atol=0.05)


def test_a_sliding_jackal_stops_after_its_friction() -> None:
    """Wheels held still by their servos, friction mu: from 1.5 m/s it slides v^2 / (2 mu g)."""
    friction = np.array([0.1, 0.2, 0.3, 0.5])
    envs = jackals(len(friction))
    envs.reset(seed=0, options={"psi": every_wheel("friction", friction) | every_wheel("damping", np.full(4, 10.0))})
    for _ in range(10):
        envs.step(np.zeros((len(friction), 2)))
    speed = 1.5
    heading = 2 * np.arctan2(envs.batch.qpos[:, 6], envs.batch.qpos[:, 3])
    envs.batch.qvel[:, 0], envs.batch.qvel[:, 1] = speed * np.cos(heading), speed * np.sin(heading)
    q, v = roll(envs, 0.0, 100)
    moved = np.hypot(*(q[..., :2] - q[0, :, :2]).transpose(2, 0, 1))
    fast = np.hypot(v[..., 0], v[..., 1]) > 0.05
    last = fast.shape[0] - 1 - fast[::-1].argmax(0)
    np.testing.assert_allclose(moved[last, np.arange(len(friction))], speed**2 / (2 * friction * GRAVITY), rtol=0.03)


def test_a_heavier_base_accelerates_less_under_the_same_thrust() -> None:
    """Full thrust on a level Quadcopter: z'' = 4 T / m - g once the motors are up; masses of each row its own."""
    base = np.array([0.5, 0.6, 0.8, 1.0])
    envs = gymnasium.make_vec("nfc_gym/QuadcopterFlat-v0", num_envs=4, context=["psi"]).unwrapped
    stiff = {f"{c}_mount_stiffness": 20.0 for c in WHEELS}  # arms that hardly bend
    envs.reset(seed=0, options={"psi": {"base_mass": base} | stiff})
    envs.batch.act[...] = 4.905
    envs.batch.qpos[:, 7:] = 0
    _, v = roll(envs, 1.0, 20)
    rise = (v[-1, :, 2] - v[20, :, 2]) / ((len(v) - 21) * DT)
    np.testing.assert_allclose(rise, 4 * 4.905 / (base + 0.4) - GRAVITY, rtol=0.01)


def test_a_lost_axle_carries_no_torque() -> None:
    """With a servo gain of 0 a wheel coasts; in a vector environment only the row that lost it veers off."""
    envs = jackals(2)
    envs.reset(seed=[5, 5], options={"psi": {"front_left_wheel_damping": np.array([0.0, 5.0])}})
    force = envs.batch.bind("actuator_force")
    for _ in range(50):
        envs.step(np.tile([0.5, 0.0], (2, 1)))
    assert force[0, 0] == 0.0
    assert force[1, 0] != 0.0
    turned = np.abs(envs.batch.qpos[:, 6] - np.sin(np.arcsin(envs.batch.qpos[1, 6])))
    assert turned[0] > 1e-3
