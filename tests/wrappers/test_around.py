"""delta_e in the robot's grid: laid where the robot starts, of one environment, a batch, anybody's heightfield."""

import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from fakes import FakeEnv, roll, same

import nfc_gym  # noqa: F401 (registers the ids)
from nfc_gym import terrain
from nfc_gym.core import Fidelity, InputError
from nfc_gym.physics.state import yaw
from nfc_gym.terrain import Heightfield
from nfc_gym.wrappers import Hallucinate, ResidualTerrain, VectorResidualTerrain
from nfc_gym.wrappers.ground import read_ground

ROUGH = {"terrain_pool": 3, "difficulty": 0.3}
FORWARD = (np.arange(128)[:, None] - 63.5) * 0.1  # m
LEFT = (np.arange(128)[None, :] - 63.5) * 0.1
AHEAD = 0.3 * np.exp(-((FORWARD - 1.0) ** 2 + LEFT**2) / (2 * 0.25**2))  # a bump 1 m ahead of the robot
LEVEL = np.full((128, 128), 0.2)
ROBOTS = ("Ant", "Quadruped", "Humanoid", "Quadcopter", "Jackal")


def one(residual: Any, robot: str = "Jackal", **more: Any) -> Any:
    return ResidualTerrain(gym.make(f"nfc_gym/{robot}Rough-v0", **ROUGH, **more), residual)


def seen_by(env: Any) -> np.ndarray:
    """(128, 128) what the robot would perceive of the residual alone, from where it stands."""
    base = env.unwrapped
    residual = Heightfield(base.heightfield.heights - base.perceived.heights)
    qpos = base.data.qpos
    return terrain.elevation(residual, (*qpos[:2], 0.0), yaw(qpos[3:7]))


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_robot_perceives_the_bump_where_its_grid_has_it(robot: str) -> None:
    """Twice bilinear, at a bump of 0.25 m: within two eighths of a cell squared times twice its curvature."""
    env = one(AHEAD, robot)
    headings = []
    for seed in range(4):
        env.reset(seed=seed)
        seen = seen_by(env)
        assert np.abs(seen - AHEAD).max() < 2 * 2 * 0.1**2 / 8 * (0.3 / 0.25**2)
        peak = np.unravel_index(seen.argmax(), seen.shape)
        assert abs(FORWARD[peak[0], 0] - 1.0) <= 0.1
        assert abs(LEFT[0, peak[1]]) <= 0.1
        headings.append(yaw(env.unwrapped.data.qpos[3:7]))
        np.testing.assert_array_equal(env.delta_e, AHEAD)
    assert np.ptp(headings) > 0.5, "at more than one heading"


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_robot_stands_on_what_is_laid(robot: str) -> None:
    """0.2 m around it: it starts 0.2 m higher, at the same place, heading alike; the map that it sees sinks by that."""
    bare, env = gym.make(f"nfc_gym/{robot}Rough-v0", **ROUGH), one(LEVEL, robot)
    for seed in (5, None, 9):
        plain, raised = bare.reset(seed=seed)[0], env.reset(seed=seed)[0]
        a, b = bare.unwrapped.data.qpos, env.unwrapped.data.qpos
        np.testing.assert_array_equal(np.delete(a, 2), np.delete(b, 2))
        if robot == "Quadcopter":  # it hovers at a height of its own
            continue
        assert b[2] - a[2] == pytest.approx(0.2, abs=1e-6)
        np.testing.assert_allclose(raised["elevation"] + 0.2, plain["elevation"], atol=1e-5)


def test_null_is_no_wrapper_bit_for_bit() -> None:
    bare = gym.make("nfc_gym/JackalRough-v0", **ROUGH)
    env = one(np.zeros((128, 128)))
    same(roll(env, 5), roll(bare, 5))
    same(env.reset()[0], bare.reset()[0])
    same(pickle.loads(pickle.dumps(env)).reset(seed=3)[0], bare.reset(seed=3)[0])


def test_the_callers_own_options_hold() -> None:
    """The map that the caller chose is what is raised, and the caller's residual is added."""
    env, whole = one(LEVEL), np.full((256, 256), 0.1)
    env.reset(seed=2, options={"terrain_id": 1, "terrain_residual": whole})
    base = env.unwrapped
    bare = gym.make("nfc_gym/JackalRough-v0", **ROUGH).unwrapped
    bare.reset(seed=2, options={"terrain_id": 1})
    np.testing.assert_array_equal(base.perceived.heights, bare.heightfield.heights)
    residual = Heightfield(base.heightfield.heights - base.perceived.heights)
    assert residual.height(base.data.qpos[:2]) == pytest.approx(0.3, abs=1e-6)
    assert residual.heights[0, 0] == pytest.approx(0.1, abs=1e-6)
    with pytest.raises(InputError, match="terrain_id is 7"):
        env.reset(options={"terrain_id": 7})


def test_ground_stays_within_what_can_be_held() -> None:
    env = one(np.full((128, 128), 30.0))
    env.reset(seed=0)
    assert env.unwrapped.heightfield.heights.max() == 11.0
    assert np.isfinite(env.step(np.zeros(2))[0]["proprio"]).all()


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_a_batch_is_its_single_environments_bit_for_bit(mode: str) -> None:
    n = 3
    envs = VectorResidualTerrain(
        gym.make_vec("nfc_gym/JackalRough-v0", num_envs=n, autoreset_mode=mode, **ROUGH), AHEAD
    )
    singles = [one(AHEAD) for _ in range(n)]
    for seed in (4, 11, None):
        got = envs.reset(seed=seed)[0]
        for i, single in enumerate(singles):
            same({k: v[i] for k, v in got.items()}, single.reset(seed=None if seed is None else seed + i)[0])
        action = np.tile([0.5, 0.2], (n, 1)).astype(np.float32)
        for _ in range(15):
            got = envs.step(action)[0]
            for i, single in enumerate(singles):
                same({k: v[i] for k, v in got.items()}, single.step(action[i])[0])
    assert len({m.heights.tobytes() for m in envs.unwrapped.heightfield}) == n
    assert envs.delta_e.shape == (n, 128, 128)


def test_later_episodes_of_a_batch_stay_on_their_ground() -> None:
    made = gym.make_vec("nfc_gym/JackalRough-v0", num_envs=3, autoreset_mode="SameStep", max_episode_steps=3, **ROUGH)
    envs = VectorResidualTerrain(made, np.stack([AHEAD, LEVEL]))
    with pytest.raises(InputError, match="residuals are drawn"):
        envs.delta_e  # noqa: B018 (raises)
    envs.reset(seed=0)
    grounds, batch, drawn = [m.heights for m in envs.unwrapped.heightfield], envs.unwrapped.batch, envs.delta_e
    for _ in range(7):
        envs.step(np.zeros((3, 2)))
    assert envs.unwrapped.batch is batch
    same([m.heights for m in envs.unwrapped.heightfield], grounds)
    same(envs.delta_e, drawn)
    with pytest.raises(InputError, match="leave the option terrain_id out"):
        envs.reset(options={"terrain_id": 0})
    envs.reset(seed=1)
    assert envs.unwrapped.batch is not batch, "other starts, so the ground is laid anew"
    envs.reset(seed=0)
    same([m.heights for m in envs.unwrapped.heightfield], grounds)


HILL = "<mujoco><option timestep='.005'/><asset><hfield name='h' nrow='{0}' ncol='{0}' size='{1} {1} .4 .1'/></asset>"
FREE = HILL + (
    "<worldbody><geom type='hfield' hfield='h'/><body name='ball' pos='0.5 -0.2 .11' euler='0 0 90'><freejoint/>"
    "<geom type='sphere' size='.1' mass='1'/></body></worldbody></mujoco>"
)
HELD = HILL + (
    "<worldbody><geom type='hfield' hfield='h'/><body pos='0 0 1'><joint type='slide'/><geom size='.1'/></body>"
    "</worldbody></mujoco>"
)


def test_on_heightfields_of_others_it_lies_around_the_start() -> None:
    env = ResidualTerrain(FakeEnv(FREE.format(201, 10)), AHEAD + LEVEL)
    assert env.reset(seed=0)[0][2] == pytest.approx(0.11 + (AHEAD + LEVEL)[54:75, 54:75].max(), abs=0.02)
    ground = read_ground(env.unwrapped.model, "x")
    assert ground.height((0.5, 0.8)) == pytest.approx(0.5, abs=0.02), "it heads along y: 1 m ahead"
    assert ground.height((0.5, -1.2)) == pytest.approx(0.2, abs=0.01)
    assert ground.height((-9.0, 9.0)) == pytest.approx(0.0, abs=1e-6)


def test_what_cannot_be_laid_is_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"FakeEnv does not say where that is.*want delta_e \(201, 201\)"):
        ResidualTerrain(FakeEnv(HELD.format(201, 10)), AHEAD)
    with pytest.raises(InputError, match=r"shape \(64, 64\); want \(256, 256\).*or \(128, 128\), the robot's grid"):
        one(AHEAD[:64, :64])
    vector = gym.make_vec("nfc_gym/JackalRough-v0", num_envs=2, **ROUGH)
    with pytest.raises(InputError, match=r"shape \(64, 64\); want \(256, 256\) or \(128, 128\)"):
        VectorResidualTerrain(vector, AHEAD[:64, :64])


def test_a_heightfield_of_the_grids_own_shape_is_the_world() -> None:
    env = ResidualTerrain(FakeEnv(FREE.format(128, 6.35)), AHEAD)
    env.reset(seed=0)
    np.testing.assert_allclose(read_ground(env.unwrapped.model, "x").heights, AHEAD, atol=1e-6)


def test_an_action_chooses_the_ground_around_the_robot() -> None:
    """Two modes, a bump ahead and one to the left, of any height: pi_h raises each of them where the robot has it."""
    left = 0.3 * np.exp(-((LEFT - 1.5) ** 2 + FORWARD**2) / (2 * 0.25**2))
    heights = 0.5 * np.random.default_rng(0).normal(size=(200, 2, 1, 1))
    posterior = Fidelity(delta_e=heights[:, 0] * AHEAD + heights[:, 1] * left)
    env = Hallucinate(gym.make("nfc_gym/JackalRough-v0", **ROUGH), posterior, modes=2, samples=200)
    assert env.action_space.shape == (4,)
    for seed in (1, 2, None):
        env.reset(seed=seed)
        started = env.unwrapped.data.qpos[:2].copy(), yaw(env.unwrapped.data.qpos[3:7])
        env.step(np.array([0, 0, 1.0, -1.0]))
        chosen = env.fidelity.delta_e
        assert chosen is not None
        assert np.abs(chosen).max() > 0.05
        base = env.unwrapped
        residual = Heightfield(base.heightfield.heights - base.perceived.heights)
        seen = terrain.elevation(residual, (*started[0], 0.0), started[1])
        assert np.abs(seen - chosen).max() < 0.1 * np.abs(chosen).max()
