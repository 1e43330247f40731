"""Wrapped environments of others in what others wrap around them."""

import gymnasium as gym
import numpy as np

from nfc_gym.wrappers import ApplyEffects


def test_any_vectorisation_of_wrapped_single_environments(tmp_path) -> None:
    """Where there is no batch: the wrappers around each environment."""
    envs = gym.make_vec(
        "Ant-v5",
        num_envs=2,
        vectorization_mode="sync",
        wrappers=[lambda e: ApplyEffects(e, [{"family": "coulomb", "where": "hip_1", "parameters": {"level": 0.2}}])],
    )
    envs.reset(seed=0)
    observation, *_ = envs.step(envs.action_space.sample())
    assert np.isfinite(observation).all()
    assert [e.unwrapped.model.dof_frictionloss[6] for e in envs.envs] == [0.2, 0.2]
