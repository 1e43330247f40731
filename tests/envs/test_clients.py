"""Other packages' checks of the environments, where those packages are installed."""

import warnings

import gymnasium
import numpy as np
import pytest

import nfc_gym  # noqa: F401 (registers the ids)

NAMES = ["nfc_gym/JackalFlat-v0", "nfc_gym/JackalRough-v0", "nfc_gym/QuadcopterFlat-v0", "nfc_gym/QuadcopterRough-v0"]
MORE = {"terrain_pool": 2}


@pytest.mark.parametrize("name", NAMES)
def test_stable_baselines(name: str) -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(gymnasium.make(name, context=["psi"], **MORE))
    checker.check_env(gymnasium.make(name, context=[], **MORE))
    checker.check_env(gymnasium.make(name, goal_conditioned=True, context=["psi"], **MORE).unwrapped)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*unconventional shape.*")  # of the map: no picture, no vector
        checker.check_env(gymnasium.make(name, **MORE))


@pytest.mark.parametrize("name", NAMES)
def test_torchrl(name: str) -> None:
    pytest.importorskip("torchrl")
    import torch
    from torchrl.envs import GymEnv, GymWrapper, check_env_specs

    torch.set_num_threads(1)
    env = GymEnv(f"nfc_gym:{name}", **MORE)
    check_env_specs(env)
    steps = env.rollout(4)
    assert steps["proprio"].dtype == torch.float32
    assert not torch.equal(steps["next", "proprio"][0], steps["next", "proprio"][1]), "arrays are not reused"
    for mode in ("SameStep", "Disabled"):
        many = GymWrapper(gymnasium.make_vec(name, num_envs=2, autoreset_mode=mode, **MORE))
        check_env_specs(many)
        assert many.rollout(3).shape == (2, 3)


def test_gymnasium_robotics_takes_it_for_a_goal_environment() -> None:
    core = pytest.importorskip("gymnasium_robotics.core")
    env = gymnasium.make("nfc_gym/JackalFlat-v0", goal_conditioned=True).unwrapped
    for name in ("compute_reward", "compute_terminated", "compute_truncated"):
        assert callable(getattr(core.GoalEnv, name))
        assert callable(getattr(env, name))


def test_gymnasiums_wrappers_and_vectorisations() -> None:
    envs = gymnasium.make_vec("nfc_gym/JackalFlat-v0", num_envs=3, context=[], max_episode_steps=5)
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(gymnasium.wrappers.vector.NormalizeObservation(envs))
    envs.reset(seed=0)
    for _ in range(7):
        obs, _, _, truncated, info = envs.step(np.zeros((3, 2), np.float32))
        assert ("episode" in info) == bool(truncated.any())
    assert obs.shape == (3, 17)
    parallel = gymnasium.make_vec("nfc_gym:nfc_gym/JackalFlat-v0", num_envs=2, vectorization_mode="async")
    ours = gymnasium.make_vec("nfc_gym/JackalFlat-v0", num_envs=2)
    a, b = parallel.reset(seed=9)[0], ours.reset(seed=9)[0]
    for key in b:
        np.testing.assert_array_equal(a[key], b[key])
    parallel.close()
