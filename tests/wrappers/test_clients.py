"""What third-party code expects of an environment holds of a wrapped one."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import nfc_gym  # noqa: F401 (registers the ids)
from nfc_gym.core import Fidelity
from nfc_gym.wrappers import (
    ApplyEffects,
    Hallucinate,
    MonitorAnomaly,
    PerceiveTerrain,
    PerturbSignals,
    RandomizePsi,
    RecordLog,
    ResidualDynamics,
    ResidualTerrain,
)

SLIP = [{"family": "slip", "where": "ground", "parameters": {"lateral": 0.3, "longitudinal": 0.1, "creep": 0.0}}]


class Quiet:
    threshold = 1.0

    def reset(self, rows=None) -> None: ...

    def update(self, obs, action, next_obs):
        return np.zeros(()) if np.ndim(action) == 1 else np.zeros(len(action))


WRAPS: dict[str, Any] = {
    "psi": lambda e, p: RandomizePsi(e, 0.5),
    "dynamics": lambda e, p: ResidualDynamics(e, 0.01 * np.ones((3, 10)), covariance=np.full(10, 1e-4)),
    "state": lambda e, p: ResidualDynamics(e, 1e-3 * np.ones(20), mode="state"),
    "terrain": lambda e, p: ResidualTerrain(e, np.stack([np.zeros((256, 256)), np.full((256, 256), 0.1)])),
    "hallucinate": lambda e, p: Hallucinate(e, Fidelity(delta_s=0.01 * np.eye(10))),
    "effects": lambda e, p: ApplyEffects(e, SLIP),
    "perceive": lambda e, p: PerceiveTerrain(e),
    "signals": lambda e, p: PerturbSignals(e, {"proprio": {"sd": 0.01, "delay": 1}, "action": {"sd": 0.1}}),
    "anomaly": lambda e, p: MonitorAnomaly(e, Quiet()),
    "record": lambda e, p: RecordLog(e, p),
}


@pytest.mark.parametrize("name", WRAPS)
def test_gymnasiums_own_checker_is_content(name: str, tmp_path) -> None:
    env = WRAPS[name](gym.make("nfc_gym/JackalRough-v0", terrain_pool=1), tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env, skip_render_check=True)
    observation, info = env.reset(seed=0)
    assert observation in env.observation_space
    for _ in range(5):
        observation, reward, ended, _, after = env.step(env.action_space.sample())
        assert observation in env.observation_space
        assert isinstance(reward, float)
        assert isinstance(ended, bool)
        assert set(after) == set(info)
        assert all(isinstance(v, np.generic | np.ndarray) for v in after.values())


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
