"""The robots' proprio, entry by entry: a residual that is injected shows up as itself in the observation."""

import gymnasium as gym
import numpy as np
import pytest

import nfc_gym  # noqa: F401 (registers the ids)
from nfc_gym.physics.residual import OBSERVED, Components
from nfc_gym.physics.state import integrate
from nfc_gym.wrappers import ResidualDynamics

ROBOTS = ("Ant", "Humanoid", "Quadruped", "Quadcopter", "Jackal")


@pytest.mark.parametrize("robot", ROBOTS)
def test_an_injected_residual_is_observed_as_itself(robot: str) -> None:
    env = gym.make(f"nfc_gym/{robot}Flat-v0", context=["psi"]).unwrapped
    env.reset(seed=1)
    for action in np.random.default_rng(0).uniform(-0.3, 0.3, (5, *env.action_space.shape)):
        env.step(action)
    names = env.proprio_components
    size = env.observation_space["proprio"].shape[0]
    assert len(names) == size
    bound = Components(env.model, names, size)

    def proprio() -> np.ndarray:
        env._view.now = env.robot.derive(env._view)
        return np.concatenate([np.asarray(p, float) for p in env.robot.proprio(env._view)], -1)

    start, qpos, qvel = proprio(), env.data.qpos.copy(), env.data.qvel.copy()
    state = [i for i, n in enumerate(names) if n != OBSERVED and ":quat" not in n]
    assert len(state) >= 8
    for i in state:
        delta = np.zeros(size)
        delta[i] = 1e-5
        step = bound.tangent(qpos, delta)
        env.data.qpos[:] = integrate(env.model, qpos, step[: env.model.nv])
        env.data.qvel[:] = qvel + step[env.model.nv :]
        change = proprio() - start
        assert change[i] == pytest.approx(1e-5, rel=1e-3), names[i]
        assert abs(np.delete(change, i)[[k - (k > i) for k in state if k != i]]).max() < 1e-8, names[i]
    env.data.qpos[:], env.data.qvel[:] = qpos, qvel
    quats = [i for i, n in enumerate(names) if ":quat" in n]
    if quats:
        turn = np.random.default_rng(1).normal(size=4)
        turn -= turn @ start[quats] * start[quats]  # what a unit quaternion can do
        delta = np.zeros(size)
        delta[quats] = 1e-5 * turn
        step = bound.tangent(qpos, delta)
        env.data.qpos[:] = integrate(env.model, qpos, step[: env.model.nv])
        np.testing.assert_allclose((proprio() - start)[quats], delta[quats], atol=1e-9)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_residual_of_the_observations_size_needs_no_names(robot: str) -> None:
    bare = gym.make(f"nfc_gym/{robot}Flat-v0", context=["psi"])
    size = bare.observation_space["proprio"].shape[0]
    delta = 0.01 * np.ones(size)
    env = ResidualDynamics(gym.make(f"nfc_gym/{robot}Flat-v0", context=["psi"]), delta)
    shown, plain = env.reset(seed=0)[0], bare.reset(seed=0)[0]
    names = env.unwrapped.proprio_components
    unseen = [i for i, n in enumerate(names) if n == OBSERVED]
    np.testing.assert_allclose(shown["proprio"][unseen] - plain["proprio"][unseen], 0.01, atol=1e-6)
    assert shown["proprio"].dtype == np.float32
    action = np.zeros(env.action_space.shape, np.float32)
    moved = env.step(action)[0]["proprio"] - bare.step(action)[0]["proprio"]
    assert (moved[[i for i, n in enumerate(names) if ":linvel" in n]] != 0).all()
