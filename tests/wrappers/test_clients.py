"""Wrapped environments of others in what others wrap around them."""

from typing import Any

import gymnasium as gym
import numpy as np

from nfc_gym.wrappers import ApplyEffects, PerturbSignals, RandomizePsi, ResidualDynamics


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


def test_memory_stays_flat_over_resets() -> None:
    import resource

    env: Any = gym.make("Ant-v5")
    env = RandomizePsi(env, space=["torso"])
    env = ApplyEffects(env, [{"family": "delay", "where": "hip_1", "parameters": {"delay": 0.03}}])
    env = ResidualDynamics(env, 0.01 * np.ones((5, 14)), covariance=np.full(14, 1e-4))
    env = PerturbSignals(env, {"observation": {"sd": 0.01, "delay": 2}})

    def episodes(count: int) -> int:
        for _ in range(count):
            env.reset()
            env.step(np.zeros(8))
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    before = episodes(100)
    assert episodes(400) - before < 2000  # KB
