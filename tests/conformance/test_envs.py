"""What every registered environment promises: spaces, seeds, pickles, specs, actions, infos, memory."""

import copy
import json
import pickle

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from cases import IDS, grown, made, numbers, play, robot_of, same
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

# proprio, goal, psi, action: the sizes that the README and the paper state.
SIZES = {
    "Ant": (52, 0, 21, 8),
    "Humanoid": (108, 0, 37, 21),
    "Quadruped": (48, 0, 13, 12),
    "Quadcopter": (21, 0, 9, 4),
    "Jackal": (15, 2, 17, 2),
}
RESETS = 100


def test_ten_ids() -> None:
    assert sorted(f"nfc_gym/{r}{g}-v0" for r in SIZES for g in ("Flat", "Rough")) == IDS


@pytest.mark.parametrize("name", IDS)
def test_spaces_and_rates(name: str) -> None:
    proprio, goal, psi, action = SIZES[robot_of(name)]
    env = made(name)
    shapes = {"proprio": (proprio,), "psi": (psi,), "elevation": (128, 128)} | ({"goal": (goal,)} if goal else {})
    assert {k: v.shape for k, v in env.observation_space.items()} == shapes
    assert all(space.dtype == np.float32 for space in env.observation_space.values())
    assert env.action_space == gym.spaces.Box(-1, 1, (action,), np.float32)
    assert env.metadata["render_fps"] == 50
    assert env.spec.max_episode_steps == 1000
    own = env.unwrapped
    assert (own.model.opt.timestep, own.frame_skip, own.dt) == (0.005, 4, 0.02)
    plain = made(name, context=[])
    assert plain.observation_space.shape == (proprio + goal,)
    assert set(made(name, context=["psi"]).observation_space) == shapes.keys() - {"elevation"}
    full, less = env.reset(seed=5)[0], plain.reset(seed=5)[0]
    np.testing.assert_array_equal(np.concatenate([full["proprio"], full.get("goal", np.zeros(0))]), less)
    for result in play(env, 6, 5):
        assert result[0] in env.observation_space


@pytest.mark.parametrize("name", IDS)
def test_gymnasiums_check(name: str) -> None:
    check_env(made(name).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("name", IDS)
def test_info_is_flat_numpy_with_the_same_keys_and_its_terms_add_up(name: str) -> None:
    env = made(name, context=["psi"])
    _, first = env.reset(seed=0)
    for _ in range(5):
        _, reward, _, _, info = env.step(env.action_space.sample())
        assert list(info) == list(first)
        assert all(isinstance(v, np.ndarray | np.generic) and v.shape == () for v in info.values())
        assert [v.dtype for v in info.values()] == [v.dtype for v in first.values()]
        assert isinstance(reward, float)
        assert reward == pytest.approx(sum(v for k, v in info.items() if k.startswith("reward/")), abs=1e-12)
    assert {"success", "distance"} <= set(first) or robot_of(name) not in ("Jackal", "Quadcopter")
    assert not first["unstable"]


@pytest.mark.parametrize("name", IDS)
def test_a_seed_fixes_every_bit(name: str) -> None:
    """In another environment, and in the same one after other episodes with another psi and ground."""
    once, again = made(name), made(name)
    expected = play(once, 7, 25)
    same(play(again, 7, 25), expected)
    space = once.unwrapped.psi_space
    once.reset(seed=8, options={"psi": space.sample(np.random.default_rng(0), 1)[0]})
    play(once, 9, 10)
    same(play(once, 7, 25), expected)
    assert not np.array_equal(play(once, 8, 0)[0][0]["proprio"], expected[0][0]["proprio"])


@pytest.mark.parametrize("name", IDS)
def test_a_pickle_goes_on(name: str) -> None:
    env = made(name, max_episode_steps=12)
    psi = env.unwrapped.psi_space.sample(np.random.default_rng(0), 1)[0]
    env.reset(seed=3, options={"psi": psi})
    for _ in range(5):
        env.step(np.zeros(env.action_space.shape, np.float32))
    twin = pickle.loads(pickle.dumps(env))
    assert twin.spec == env.spec
    for _ in range(10):
        action = env.action_space.sample()
        a, b = env.step(action), twin.step(action)
        same(a, b)
        if a[2] or a[3]:  # a time limit too goes on counting where it was
            same(env.reset(), twin.reset())
    same(env.reset(), twin.reset())


@pytest.mark.parametrize("name", IDS)
def test_spec_through_json(name: str) -> None:
    env = made(name, context=["psi"], elevation_hz=10)
    twin = gym.make(EnvSpec.from_json(json.dumps(json.loads(env.spec.to_json()))))
    assert twin.spec.kwargs == env.spec.kwargs
    same(play(env, 1, 5), play(twin, 1, 5))


@pytest.mark.parametrize("name", IDS)
def test_finite_actions_never_give_nan_and_are_clipped(name: str) -> None:
    """Of any size: the largest there is, alternating between the ends, random ones far outside."""
    env, twin = made(name, context=["psi"]), made(name, context=["psi"])
    rng, shape = np.random.default_rng(0), env.action_space.shape
    signs = np.where(np.arange(shape[0]) % 2, 1.0, -1.0)
    env.reset(seed=0)
    twin.reset(seed=0)
    for k in range(60):
        action = (1e308 * signs, 1e308 * signs * (-1) ** k, rng.normal(0, 1e3, shape))[k // 20]
        given = action.copy()
        result, inside = env.step(given), twin.step(np.clip(action, -1, 1))
        same(result, inside, f"step {k}")
        assert np.array_equal(given, action), "the caller's array is not written to"
        assert all(np.isfinite(v).all() for v in numbers(result))
        assert result[0] in env.observation_space
        if result[2]:
            same(env.reset(), twin.reset())


@pytest.mark.parametrize("name", IDS)
def test_bad_actions_are_named(name: str) -> None:
    env, vector = made(name, context=["psi"]), gym.make_vec(name, num_envs=2, context=["psi"], terrain_pool=1)
    env.reset(seed=0)
    vector.reset(seed=0)
    before = env.unwrapped.data.qpos.copy()
    for bad in (np.nan, np.inf, -np.inf):
        action = np.zeros(vector.action_space.shape)
        action[1, 1] = bad
        with pytest.raises(ValueError, match=rf"action\[1\] is {bad}"):
            env.step(action[1])
        with pytest.raises(ValueError, match=rf"action\[1, 1\] is {bad}"):
            vector.step(action)
    with pytest.raises(ValueError, match="has shape"):
        env.step(np.zeros(env.action_space.shape[0] + 1))
    np.testing.assert_array_equal(env.unwrapped.data.qpos, before)


@pytest.mark.parametrize("name", IDS)
def test_memory_is_flat_over_resets(name: str) -> None:
    env = made(name, context=["psi"], terrain_pool=1)
    env.reset(seed=0)
    assert grown(env.reset, RESETS) < RESETS / 4 * mujoco.mj_sizeModel(env.unwrapped.model)


@pytest.mark.parametrize("name", IDS)
def test_memory_of_vectors_is_flat_over_resets(name: str) -> None:
    envs = gym.make_vec(name, num_envs=4, nthread=1, context=["psi"], terrain_pool=2)
    envs.reset(seed=0)
    assert grown(envs.reset, RESETS // 5) < RESETS / 5 / 4 * mujoco.mj_sizeModel(envs.unwrapped.model)


def test_a_leak_of_a_model_each_reset_would_be_seen() -> None:
    env = made("nfc_gym/JackalFlat-v0", context=["psi"])
    kept = []

    def leaky() -> None:
        env.reset()
        kept.append(copy.copy(env.unwrapped.model))

    assert grown(leaky, 50) > 50 / 4 * mujoco.mj_sizeModel(env.unwrapped.model)


@pytest.mark.parametrize("name", IDS)
def test_pictures(name: str) -> None:
    env = made(name, context=[], render_mode="rgb_array", width=96, height=64)
    env.reset(seed=0)
    try:
        picture = env.render()
    except Exception as error:  # no graphics library at all
        pytest.skip(f"cannot render here: {error}")
    assert picture.shape == (64, 96, 3)
    assert picture.dtype == np.uint8
    assert picture.std() > 5, "a picture, not one colour"
    env.close()
