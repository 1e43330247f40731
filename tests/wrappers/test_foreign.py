"""Every wrapper around environments written by others: Gymnasium's and gymnasium-robotics'."""

import pickle
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from fakes import roll, same

from nfc_gym.core import Fidelity
from nfc_gym.physics.effects.saved import to_row
from nfc_gym.wrappers import (
    ApplyEffects,
    Hallucinate,
    MonitorAnomaly,
    PerceiveTerrain,
    PerturbSignals,
    RandomizePsi,
    RecordLog,
    ResidualDynamics,
)

# id -> (a body, a hinge or slide, entries of the residual dynamics)
IDS = {
    "Ant-v5": ("torso", "hip_1"),
    "Humanoid-v5": ("torso", "right_knee"),
    "AntMaze_UMaze-v5": ("torso", "ankle_2"),
    "PointMaze_UMaze-v3": ("particle", "ball_x"),
}


class Quiet:
    threshold = 1.0

    def reset(self, rows=None) -> None: ...

    def update(self, obs, action, next_obs):
        return 0.0


def make(name: str) -> gym.Env:
    import gymnasium_robotics

    gym.register_envs(gymnasium_robotics)
    return gym.make(name)


def null(name: str, env: gym.Env, folder: Path) -> list[Any]:
    """Each wrapper with what changes nothing."""
    body, joint = IDS[name]
    model = env.unwrapped.model
    mass = float(model.body(body).mass[0])
    nv = model.nv
    coulomb = {"family": "coulomb", "where": joint, "parameters": {"level": 0.0}}
    key = "observation"
    return [
        lambda e: RandomizePsi(e, {body: (mass, mass)}),
        lambda e: ResidualDynamics(e, np.zeros(nv)),
        lambda e: ResidualDynamics(e, np.zeros(2 * nv), mode="state"),
        lambda e: ApplyEffects(e, [coulomb]),
        lambda e: PerturbSignals(e, {key: {"sd": 0.0}, "action": {"bias": 0.0}}),
        lambda e: MonitorAnomaly(e, Quiet()),
        lambda e: RecordLog(e, folder),
    ]


@pytest.mark.parametrize("name", IDS)
def test_null_is_no_wrapper_bit_for_bit(name: str, tmp_path: Path) -> None:
    expected = roll(make(name), 6)
    for wrap in null(name, make(name), tmp_path):
        same(roll(wrap(make(name)), 6), expected)
    together = make(name)
    for wrap in null(name, make(name), tmp_path / "all"):
        together = wrap(together)
    same(roll(together, 6), expected)
    same(roll(together, 6), expected)


@pytest.mark.parametrize("name", IDS)
def test_each_wrapper_changes_what_it_should(name: str) -> None:
    body, joint = IDS[name]
    bare = roll(make(name), 6)
    nv = make(name).unwrapped.model.nv
    coulomb = {"family": "coulomb", "where": joint, "parameters": {"level": 3.0}}
    for wrap in (
        lambda e: RandomizePsi(e, space=[body]),
        lambda e: ResidualDynamics(e, np.full(nv, 0.05)),
        lambda e: ResidualDynamics(e, np.full(nv, 0.05), mode="state"),
        lambda e: ApplyEffects(e, [coulomb]),
        lambda e: PerturbSignals(e, {"action": {"bias": 0.1}}),
    ):
        env = wrap(make(name))
        changed = roll(env, 6)
        if not isinstance(env, RandomizePsi):  # Humanoid-v5 observes inertias
            same(changed[0], bare[0])
        assert _apart(changed[-1][0], bare[-1][0]), env
        same(roll(env, 6), changed)


def _apart(a: Any, b: Any) -> bool:
    return any((a[k] != b[k]).any() for k in a) if isinstance(a, dict) else bool((a != b).any())


@pytest.mark.parametrize("name", IDS)
def test_hallucinated_worlds(name: str) -> None:
    body, _ = IDS[name]
    env = make(name)
    mass, nv = float(env.unwrapped.model.body(body).mass[0]), env.unwrapped.model.nv
    rng = np.random.default_rng(0)
    world = Fidelity(psi=mass * rng.uniform(0.8, 1.2, (200, 1)), delta_s=0.02 * rng.standard_normal((200, nv)))
    env = Hallucinate(env, world, space=[body])
    own = env.unwrapped.action_space.shape[0]
    assert env.action_space.shape == (own + 1 + nv,)
    env.reset(seed=0)
    heavy = np.zeros(own + 1 + nv, env.action_space.dtype)
    heavy[own] = 1
    env.step(heavy)
    first = float(env.unwrapped.model.body(body).mass[0])
    assert first > 1.05 * mass
    env.step(-heavy)
    assert env.unwrapped.model.body(body).mass[0] == first
    env.reset(seed=0)
    assert env.unwrapped.model.body(body).mass[0] == pytest.approx(mass, rel=0.03)


@pytest.mark.parametrize("name", ["Ant-v5", "AntMaze_UMaze-v5"])
def test_perceived_ground(name: str) -> None:
    env = PerceiveTerrain(make(name), {"drift": 0.0, "yaw_drift": 0.0})
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space
    for _ in range(10):
        observation, *_ = env.step(np.zeros(8))
    assert env.valid.any()
    height = env.unwrapped.data.qpos[2]
    assert abs(observation["elevation"][env.valid] + height).mean() < 0.1


def test_the_mazes_goals_and_rewards_stay(tmp_path: Path) -> None:
    env = RecordLog(RandomizePsi(make("PointMaze_UMaze-v3"), space=["particle"]), tmp_path)
    observation, info = env.reset(seed=0, options={"goal_cell": np.array([1, 1]), "psi": {"particle": 4.0}})
    assert set(observation) == {"observation", "achieved_goal", "desired_goal"}
    assert "success" in info
    particle = env.unwrapped.model.body("particle").mass[0]
    assert particle == 4.0


@pytest.mark.parametrize("name", IDS)
def test_stacks_are_pickled_and_remade_from_their_spec(name: str, tmp_path: Path) -> None:
    _, joint = IDS[name]
    env = make(name)
    Fidelity(delta_s=0.01 * np.ones(env.unwrapped.model.nv)).save(tmp_path / "delta.npz")
    env = ResidualDynamics(env, tmp_path / "delta.npz")
    env = ApplyEffects(env, [{"family": "coulomb", "where": joint, "parameters": {"level": 0.5}}])
    env = PerturbSignals(env, {"action": {"delay": 1}})
    expected = roll(env, 5)
    same(roll(pickle.loads(pickle.dumps(env)), 5), expected)
    same(roll(gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json())), 5), expected)


def test_effects_reach_unnamed_actuators_by_the_joint_they_move() -> None:
    """A log of Ant-v5 calls its motors after their joints; what is found there must find its way back."""
    gain = {"family": "gain", "where": "hip_1", "parameters": {"gain": -0.5}}
    env = ApplyEffects(make("Ant-v5"), [gain])
    assert _apart(roll(env, 3)[-1][0], roll(make("Ant-v5"), 3)[-1][0])
    row = to_row(env.effects[0], env.thetas[0])
    assert row["where"] == ["hip_1"]
