"""`ResidualDynamics`: a force M dv / T gives the residual, contacts answer to it, and zero changes nothing."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from fakes import FakeEnv, Gaussian, NoModel, Own, ZooEnv, roll, same

from nfc_gym.core import Fidelity, InputError
from nfc_gym.physics.residual import Components
from nfc_gym.physics.state import Inertia, difference, quat_to_vector, rotate_back
from nfc_gym.wrappers import ResidualDynamics

T = 4 * 0.005  # s, the fake's control step
NONE = np.zeros(1)


def test_inertia_times_velocity_is_mujocos_own() -> None:
    env = ZooEnv()
    env.reset(seed=0)
    env.step(np.zeros(7))
    speed, expected = np.random.default_rng(0).normal(size=env.model.nv), np.zeros(env.model.nv)
    mujoco.mj_mulM(env.model, env.data, expected, speed)
    np.testing.assert_allclose(Inertia(env.model).times(env.data.M, speed), expected, rtol=1e-12, atol=1e-15)


def test_a_free_body_gains_the_residual_each_control_step() -> None:
    """No gravity, no contact: M dv / T over T is dv, and the body goes as far as a constant acceleration takes it."""
    dv = np.array([0.3, -0.2, 0.1, 0, 0, 0, 0])
    env = ResidualDynamics(FakeEnv(), dv)
    start = env.reset(seed=0)[0][:3]
    for k in range(1, 6):
        observation = env.step(NONE)[0]
        np.testing.assert_allclose(observation[8:11], k * dv[:3], rtol=1e-9)
    # semi-implicit Euler with n steps of h: h^2 a n (n + 1) / 2
    np.testing.assert_allclose(observation[:3] - start, dv[:3] / T * 0.005**2 * 20 * 21 / 2, rtol=1e-9)
    np.testing.assert_array_equal(env.unwrapped.data.qfrc_applied, 0)


def test_contacts_answer_to_the_force() -> None:
    """Pushed into the floor a cube stays on it; told outright, it sinks."""
    xml = "<mujoco><option timestep='.005'/><worldbody><geom type='plane' size='5 5 .1'/><body name='c' pos='0 0 .1'>"
    xml += "<freejoint/><geom type='box' size='.1 .1 .1' mass='1'/></body></worldbody></mujoco>"
    down = np.array([0, 0, -0.1, 0, 0, 0])
    pushed, told = ResidualDynamics(FakeEnv(xml), down), ResidualDynamics(FakeEnv(xml), down, mode="state")
    for env in (pushed, told):
        env.reset(seed=0)
        for _ in range(10):
            env.step(np.zeros(0))
    assert abs(pushed.unwrapped.data.qvel[2]) < 0.01
    assert told.unwrapped.data.qvel[2] < -0.05


@pytest.mark.parametrize("mode", ["force", "state"])
def test_null_is_no_wrapper_bit_for_bit(mode: str) -> None:
    for size in (ZooEnv().model.nv, 2 * ZooEnv().model.nv):
        env = ResidualDynamics(ZooEnv(), np.zeros(size), mode=mode)  # type: ignore[arg-type]
        same(roll(env, 6), roll(ZooEnv(), 6))


def test_state_mode_adds_positions_in_tangent_space() -> None:
    step = np.zeros(14)
    step[3:6] = (0.0, 0.0, 0.2)  # rad about the body's z, each control step
    step[7:10] = (0.1, 0, 0)
    env = ResidualDynamics(FakeEnv(), step, mode="state")
    env.reset(seed=0)
    for _ in range(3):
        observation = env.step(NONE)[0]
    np.testing.assert_allclose(quat_to_vector(observation[3:7]), [0, 0, 0.6], atol=1e-12)
    assert np.linalg.norm(observation[3:7]) == pytest.approx(1)
    # The speed after a step is the one added; the body has moved with what it had before: 0, 0.1, 0.2 over T.
    np.testing.assert_allclose(observation[8], 0.3, rtol=1e-12)
    np.testing.assert_allclose(observation[0], 0.3 * T, rtol=1e-9)


def test_a_bias_holds_for_an_episode_and_noise_is_drawn_each_step() -> None:
    samples = np.random.default_rng(0).normal(size=(50, 7))
    env = ResidualDynamics(FakeEnv(), samples)
    biases = []
    for seed in (1, 2, 1):
        env.reset(seed=seed)
        biases.append(env.delta_s)
        assert (samples == env.delta_s).all(1).any()
        env.step(NONE)
        np.testing.assert_array_equal(env.delta_s, biases[-1])
    np.testing.assert_array_equal(biases[0], biases[2])
    assert (biases[0] != biases[1]).any()

    covariance = np.zeros((7, 7))
    covariance[:2, :2] = [[0.04, 0.03], [0.03, 0.09]]
    env = ResidualDynamics(FakeEnv(), np.zeros(7), covariance=covariance)
    env.reset(seed=0)
    speeds = np.array([env.step(NONE)[0][8:10] for _ in range(3000)])
    jumps = np.diff(speeds, axis=0)
    np.testing.assert_allclose(np.cov(jumps.T), covariance[:2, :2], atol=0.01)
    assert abs(jumps).max() < 2


def test_a_seed_repeats_noise_and_the_environments_own_draws_stay() -> None:
    env, bare = gym.make("Ant-v5"), gym.make("Ant-v5")
    noisy = ResidualDynamics(env, Gaussian("delta_s", np.zeros(14), 0.05), covariance=np.full(14, 1e-3))
    first, second = roll(noisy, 5, seed=4), roll(noisy, 5, seed=4)
    same(first, second)
    same(first[0], bare.reset(seed=4)[0])
    noisy.reset()
    bare.reset()
    same(noisy.reset()[0], bare.reset()[0])


def test_named_components_go_where_they_belong() -> None:
    model = FakeEnv().model
    names = ["body:cube:quat.w", "body:cube:quat.x", "body:cube:quat.y", "body:cube:quat.z", "obs"]
    names += [f"body:cube:linvel@body.{a}" for a in "xyz"] + [f"body:cube:angvel.{a}" for a in "xyz"]
    names += [f"body:cube:pos.{a}" for a in "xyz"] + ["joint:hinge:vel", "joint:hinge:pos"]
    components = Components(model, names, len(names))
    rng = np.random.default_rng(0)
    q = np.concatenate([rng.normal(size=3), rng.normal(size=4), [0.3]])
    q[3:7] /= np.linalg.norm(q[3:7])
    delta = 1e-6 * rng.normal(size=16)
    out = components.tangent(q, delta)
    moved = q.copy()
    moved[3:7] += delta[:4]
    moved[3:7] /= np.linalg.norm(moved[3:7])
    moved[:3] += delta[11:14]
    moved[7] += delta[15]
    np.testing.assert_allclose(out[:7], difference(model, q, moved), atol=1e-11)
    np.testing.assert_allclose(rotate_back(q[3:7], out[7:10]), delta[5:8], atol=1e-18)
    np.testing.assert_allclose(out[10:13], rotate_back(q[3:7], delta[8:11]), atol=1e-18)
    assert out[13] == delta[14]
    np.testing.assert_array_equal(components.observed, [4])
    # and with a batch in front
    np.testing.assert_array_equal(components.tangent(np.stack([q, q]), np.stack([delta, 2 * delta]))[0], out)


def test_a_width_that_the_observation_has_not_is_told() -> None:
    env = gym.wrappers.FlattenObservation(gym.make("nfc_gym/JackalFlat-v0", context=["psi"]))
    nested = gym.wrappers.TransformObservation(env, lambda o: {"flat": o}, gym.spaces.Dict(flat=env.observation_space))
    with pytest.raises(InputError, match=r"wants a key of the observation with shape \(15,\).*'flat' \(34,\)"):
        ResidualDynamics(nested, np.zeros(15))


def test_entries_that_are_no_state_perturb_what_is_observed() -> None:
    names = ["obs"] * 15
    names[8:11] = [f"body:cube:linvel.{a}" for a in "xyz"]
    delta = np.arange(15.0)
    delta[8:11] = 0
    env = ResidualDynamics(FakeEnv(), delta, components=names)
    same(env.reset(seed=0)[0], FakeEnv().reset(seed=0)[0] + delta)


def test_bad_input_is_refused_by_name(tmp_path) -> None:
    with pytest.raises(InputError, match="MuJoCo"):
        ResidualDynamics(NoModel(), np.zeros(7))
    with pytest.raises(InputError, match="nv = 7"):
        ResidualDynamics(FakeEnv(), np.zeros(6))
    with pytest.raises(InputError, match="force, state"):
        ResidualDynamics(FakeEnv(), np.zeros(7), mode="both")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"\(7, 7\)"):
        ResidualDynamics(FakeEnv(), np.zeros(7), covariance=np.zeros(6))
    with pytest.raises(InputError, match="eigenvalue"):
        ResidualDynamics(FakeEnv(), np.zeros(7), covariance=np.full(7, -1.0))
    with pytest.raises(InputError, match="cube"):
        ResidualDynamics(FakeEnv(), np.zeros(1), components=["body:cub:linvel.x"])
    with pytest.raises(InputError, match="joint:<name>"):
        ResidualDynamics(FakeEnv(), np.zeros(1), components=["cube.x"])
    with pytest.raises(InputError, match="psi"):
        ResidualDynamics(FakeEnv(), Fidelity(psi=np.zeros(3)))
    with pytest.raises(InputError, match="no loader"):
        ResidualDynamics(FakeEnv(), tmp_path / "posterior.pt")
    with pytest.raises(InputError, match="no such file"):
        ResidualDynamics(FakeEnv(), tmp_path / "posterior.npz")
    with pytest.raises(InputError, match=r"components is 5; want a list of 1 names"):
        ResidualDynamics(FakeEnv(), np.zeros(1), components=5)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="the observation has no key 'wind'; it has: none"):
        ResidualDynamics(FakeEnv(), np.zeros(7), key="wind")
    with pytest.raises(InputError, match="VectorResidualDynamics"):
        ResidualDynamics(gym.make_vec("Ant-v5", 1), np.zeros(14))  # type: ignore[arg-type]


def test_a_stepper_without_a_place_for_hooks_is_refused() -> None:
    class Own(gym.Env):
        def __init__(self) -> None:
            self.model = mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")
            self.data = mujoco.MjData(self.model)

    with pytest.raises(InputError, match="substep_hooks"):
        ResidualDynamics(Own(), np.zeros(0))


def test_the_first_control_step_counts_where_a_reset_computes_nothing() -> None:
    """A reset that runs no `mj_forward` leaves an inertia of zero behind."""
    dv = np.array([0.3, 0, 0, 0, 0, 0, 0])
    env = ResidualDynamics(Own(), dv)
    env.reset(seed=0)
    for k in range(1, 4):
        np.testing.assert_allclose(env.step(NONE)[0][8], k * dv[0], rtol=1e-9)


def test_a_covariance_of_words_is_refused() -> None:
    with pytest.raises(InputError, match="covariance is 'a', want numbers"):
        ResidualDynamics(FakeEnv(), np.zeros(7), covariance="a")  # type: ignore[arg-type]
