"""What every environment promises, over all ids that are registered: spaces, info, resets, determinism, bad input."""

import json
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

from nfc_gym import InputError

IDS = sorted(i for i in gymnasium.registry if i.startswith("nfc_gym/"))
# proprio, goal, psi, action: the sizes that the README and the paper state.
SIZES = {
    "Ant": (52, 0, 21, 8),
    "Humanoid": (108, 0, 37, 21),
    "Quadruped": (48, 0, 13, 12),
    "Quadcopter": (21, 0, 9, 4),
    "Jackal": (15, 2, 17, 2),
}
SMALL = {"terrain_pool": 3}


def made(name: str, **kwargs: Any) -> gymnasium.Env:
    return gymnasium.make(name, **(SMALL | kwargs))


def robot_of(name: str) -> str:
    return name.removeprefix("nfc_gym/").removesuffix("Flat-v0").removesuffix("Rough-v0")


def same(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return np.array_equal(a, b) and np.asarray(a).dtype == np.asarray(b).dtype


def play(env: gymnasium.Env, seed: int, steps: int) -> list[Any]:
    rng = np.random.default_rng(seed)
    out: list[Any] = [env.reset(seed=seed)]
    for _ in range(steps):
        out.append(env.step(rng.uniform(-1, 1, env.action_space.shape)))
        if out[-1][2]:
            out.append(env.reset())
    return out


def test_ten_ids() -> None:
    assert sorted(f"nfc_gym/{r}{g}-v0" for r in SIZES for g in ("Flat", "Rough")) == IDS


@pytest.mark.parametrize("name", IDS)
def test_spaces_and_rates(name: str) -> None:
    proprio, goal, psi, action = SIZES[robot_of(name)]
    env = made(name)
    shapes = {"proprio": (proprio,), "psi": (psi,), "elevation": (128, 128)} | ({"goal": (goal,)} if goal else {})
    assert {k: v.shape for k, v in env.observation_space.items()} == shapes
    assert all(space.dtype == np.float32 for space in env.observation_space.values())
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (action,), np.float32)
    assert env.metadata["render_fps"] == 50
    assert env.spec.max_episode_steps == 1000
    own = env.unwrapped
    assert (own.model.opt.timestep, own.frame_skip, own.dt) == (0.005, 4, 0.02)
    plain = made(name, context=[])
    assert plain.observation_space.shape == (proprio + goal,)
    assert set(made(name, context=["psi"]).observation_space) == shapes.keys() - {"elevation"}
    full, less = env.reset(seed=5)[0], plain.reset(seed=5)[0]
    np.testing.assert_array_equal(np.concatenate([full["proprio"], full.get("goal", np.zeros(0))]), less)


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
        assert isinstance(reward, float)
        assert reward == pytest.approx(sum(v for k, v in info.items() if k.startswith("reward/")), abs=1e-12)
    assert {"success", "distance"} <= set(first) or robot_of(name) not in ("Jackal", "Quadcopter")
    assert not first["unstable"]


@pytest.mark.parametrize("name", IDS)
def test_a_seed_fixes_every_bit_and_a_pickle_goes_on(name: str) -> None:
    once, again = made(name), made(name)
    assert all(same(a, b) for a, b in zip(play(once, 7, 30), play(again, 7, 30), strict=True))
    twin = pickle.loads(pickle.dumps(once))
    assert twin.spec == once.spec
    for _ in range(10):
        action = once.action_space.sample()
        a, b = once.step(action), twin.step(action)
        assert same(a, b)
        if a[2]:
            a, b = once.reset(), twin.reset()
            assert same(a[0], b[0])
    assert same(once.reset()[0], twin.reset()[0]), "the generators stand at the same number"


@pytest.mark.parametrize("name", IDS)
def test_spec_through_json(name: str) -> None:
    env = made(name, context=["psi"], elevation_hz=10)
    twin = gymnasium.make(EnvSpec.from_json(json.dumps(json.loads(env.spec.to_json()))))
    assert same(env.reset(seed=1)[0], twin.reset(seed=1)[0])


@pytest.mark.parametrize("name", IDS)
def test_actions(name: str) -> None:
    env, twin = made(name, context=["psi"]), made(name, context=["psi"])
    env.reset(seed=0)
    twin.reset(seed=0)
    big = np.where(np.arange(env.action_space.shape[0]) % 2, 1e308, -9.0)
    given = big.copy()
    assert same(env.step(given)[0], twin.step(np.clip(big, -1, 1))[0])
    assert np.array_equal(given, big), "the caller's array is not written to"
    for bad in (np.nan, np.inf):
        action = np.zeros(env.action_space.shape)
        action[1] = bad
        with pytest.raises(ValueError, match=rf"action\[1\] is {bad}"):
            env.step(action)
    with pytest.raises(InputError, match="has shape"):
        env.step(np.zeros(env.action_space.shape[0] + 1))


@pytest.mark.parametrize("name", IDS)
def test_a_simulation_that_comes_apart_ends_without_nan(name: str) -> None:
    env = made(name)
    env.reset(seed=0)
    for poison in (np.nan, 1e9):
        env.unwrapped.data.qvel[0] = poison
        obs, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
        assert info["unstable"]
        assert terminated
        assert not truncated
        assert reward == 0
        assert all(np.isfinite(v).all() for v in (*obs.values(), *info.values()))
        env.reset()
    assert not env.step(np.zeros(env.action_space.shape))[4]["unstable"]


@pytest.mark.parametrize("name", IDS)
def test_psi_is_set_seen_and_read_back(name: str) -> None:
    env = made(name, context=["psi"])
    own = env.unwrapped
    space = own.psi_space
    obs, _ = env.reset(seed=0)
    np.testing.assert_array_equal(own.psi, space.nominal)
    np.testing.assert_allclose(obs["psi"], np.clip(space.normalise(space.nominal), -1, 1), atol=1e-6)
    wanted = space.sample(np.random.default_rng(0), 1)[0]
    obs, _ = env.reset(options={"psi": wanted})
    np.testing.assert_array_equal(own.psi, wanted)
    np.testing.assert_allclose(space.denormalise(obs["psi"]), wanted, rtol=1e-5, atol=1e-5)
    for name_, value, bound in zip(space.names, wanted, space._bound, strict=True):
        if "restitution" not in name_:
            assert space._read(own.model, bound) == pytest.approx(value, rel=1e-12), name_
    obs, _ = env.reset(options={"psi": {space.names[0]: wanted[0]}, "psi_belief": {space.names[1]: wanted[1]}})
    expected = space.nominal.copy()
    expected[0] = wanted[0]
    np.testing.assert_array_equal(own.psi, expected)
    believed = space.nominal.copy()
    believed[1] = wanted[1]
    np.testing.assert_allclose(space.denormalise(obs["psi"]), believed, rtol=1e-5, atol=1e-5)
    env.reset()
    np.testing.assert_array_equal(own.psi, space.nominal)
    np.testing.assert_array_equal(own.model.body_mass, own.fields.nominal("body_mass"))


def test_psi_may_leave_the_prior_but_not_physics() -> None:
    env = made("nfc_gym/JackalFlat-v0", context=["psi"])
    obs, _ = env.reset(options={"psi": {"base_mass": 60.0}})
    assert obs["psi"][0] == 1.0
    assert env.unwrapped.model.body("base").mass == 60.0
    for bad, message in (
        ({"base_mass": 0.0}, "mass must be positive"),
        ({"base_mass": np.nan}, "base_mass is not finite"),
        ({"bas_mass": 1.0}, "no parameter 'bas_mass'; there are: base_mass"),
        (np.zeros(3), r"shape \(3,\), want \(17,\)"),
    ):
        with pytest.raises(InputError, match=message):
            env.reset(options={"psi": bad})


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"context": ["psy"]}, "want a sequence of: psi, elevation"),
        ({"context": "psi"}, "want a sequence"),
        ({"elevation_hz": 30}, "50 divided by a whole number"),
        ({"task": "fly"}, "it has: goal, figure8"),
        ({"render_mode": "ascii"}, "human, rgb_array"),
        ({"terrain_pool": 0}, "1 or more"),
        ({"difficulty": 2}, "from 0 to 1"),
        ({"terrain_kind": "lava"}, "want one of: "),
        ({"reward_type": "rich"}, "sparse, dense"),
    ],
)
def test_bad_arguments_say_what_is_valid(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        made("nfc_gym/JackalRough-v0", **kwargs)
    with pytest.raises(InputError, match=message.replace("human, ", "")):
        gymnasium.make_vec("nfc_gym/JackalRough-v0", num_envs=2, **(SMALL | kwargs))


def test_only_robots_with_goals_are_goal_conditioned() -> None:
    with pytest.raises(InputError, match="ant has no goals"):
        made("nfc_gym/AntFlat-v0", goal_conditioned=True)


def test_reset_options_are_checked() -> None:
    flat, rough = made("nfc_gym/JackalFlat-v0"), made("nfc_gym/JackalRough-v0")
    with pytest.raises(InputError, match="no option 'pis'; it has: psi, psi_belief"):
        flat.reset(options={"pis": 1})
    with pytest.raises(InputError, match="use the Rough one"):
        flat.reset(options={"terrain_id": 1})
    for options, message in (
        ({"terrain_id": 3}, "from 0 to 2"),
        ({"terrain_id": 0.5}, "whole number"),
        ({"heightfield": np.zeros((5, 5))}, r"shape \(5, 5\), want \(256, 256\)"),
        ({"heightfield": np.full((256, 256), np.nan)}, "not finite"),
        ({"heightfield": np.full((256, 256), 99.0)}, "-5 to 11 m"),
        ({"heightfield": np.zeros((256, 256)), "terrain_id": 1}, "give one of them"),
    ):
        with pytest.raises(InputError, match=message):
            rough.reset(options=options)


def test_input_errors_are_value_errors() -> None:
    assert issubclass(InputError, ValueError)
