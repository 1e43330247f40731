"""Ant-v5 on this package's engine is Gymnasium's: the benchmark times the same work."""

import sys
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest

from nfc_gym.envs.single import RobotEnv
from nfc_gym.envs.vector import RobotVectorEnv

pytest.importorskip("imageio", reason="Gymnasium's own MuJoCo environments need gymnasium[mujoco]")
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from peers.ant_v5 import AntV5, AntV5ContactVectorEnv

WITHOUT = {"include_cfrc_ext_in_observation": False, "contact_cost_weight": 0.0}


@pytest.mark.parametrize("contact", [False, True])
def test_equals_gymnasiums(contact: bool) -> None:
    n = 3
    more = {"num_envs": n, "autoreset_mode": "Disabled"}
    envs = AntV5ContactVectorEnv(**more) if contact else RobotVectorEnv(AntV5, context=(), **more)
    peers = [gymnasium.make("Ant-v5", **({} if contact else WITHOUT)).unwrapped for _ in range(n)]
    assert envs.single_observation_space == peers[0].observation_space
    assert envs.dt == peers[0].dt
    envs.reset(seed=0)
    rng, ended, resets = np.random.default_rng(0), np.ones(n, bool), 0
    for _ in range(80):
        for i in np.flatnonzero(ended):
            peers[i].reset()
            mujoco.mj_resetData(peers[i].model, peers[i].data)
            peers[i].set_state(envs.batch.qpos[i], envs.batch.qvel[i])
        actions = rng.uniform(-1, 1, (n, 8))
        obs, reward, ended, _, _ = envs.step(actions)
        for i, peer in enumerate(peers):
            theirs = peer.step(actions[i])
            np.testing.assert_allclose(obs[i], theirs[0], rtol=0, atol=1e-9)
            assert reward[i] == pytest.approx(theirs[1], abs=1e-9)
            assert ended[i] == theirs[2]
        resets += ended.sum()
        if ended.any():
            envs.reset(options={"reset_mask": ended})
    assert resets, "an end was met"
    assert contact == bool(np.abs(obs[:, 27:]).max(initial=0) > 0.1), "feet have touched the ground"


def test_a_robot_from_outside_the_package_runs_on_both_engines() -> None:
    """It brings its own model, step and precision, has no psi, and starts with a velocity."""
    env, envs = RobotEnv(AntV5, context=()), RobotVectorEnv(AntV5, context=(), num_envs=2)
    one, many = env.reset(seed=1)[0], envs.reset(seed=0)[0]
    assert one.dtype == np.float64
    assert env.metadata["render_fps"] == 20
    np.testing.assert_array_equal(one, many[1])
    for _ in range(5):
        np.testing.assert_array_equal(env.step(np.full(8, 0.3))[0], envs.step(np.full((2, 8), 0.3))[0][1])
