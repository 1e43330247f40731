"""What every environment promises, over all ids that are registered: spaces, info, resets, determinism, bad input."""

import pickle
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from nfc_gym import InputError

IDS = sorted(i for i in gymnasium.registry if i.startswith("nfc_gym/"))
SMALL = {"terrain_pool": 3}


def made(name: str, **kwargs: Any) -> gymnasium.Env:
    return gymnasium.make(name, **(SMALL | kwargs))


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
        (np.zeros(3), r"shape \(3,\), want \((2, )?17,?\)"),
        ({"base_mass": "heavy"}, "base_mass'\\] is 'heavy', want a number"),
        ("heavy", "psi is 'heavy', want a number"),
        ({"front_left_wheel_friction": -0.1}, "front_left_wheel_friction' is -0.1, want 0 or more"),
        ({"front_left_wheel_damping": -5}, "front_left_wheel_damping' is -5 N m s/rad, want 0 or more"),
        ({"front_left_wheel_restitution": 3}, "front_left_wheel_restitution' is 3, want a number from 0 to 1"),
    ):
        for one_or_two in (env, gymnasium.make_vec("nfc_gym/JackalFlat-v0", num_envs=2)):
            with pytest.raises(InputError, match=message):
                one_or_two.reset(options={"psi": bad})
    with pytest.raises(InputError, match="rear_right_ankle_stiffness' is -1 N m/rad"):
        made("nfc_gym/AntFlat-v0").reset(options={"psi": {"rear_right_ankle_stiffness": -1}})
    with pytest.raises(InputError, match="'front_left_wheel_friction' is -1"):
        gymnasium.make_vec("nfc_gym/JackalFlat-v0", num_envs=2).reset(
            options={"psi": {"front_left_wheel_friction": [1.0, -1.0]}}
        )


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"context": ["psy"]}, "want a sequence of: psi, elevation"),
        ({"context": "psi"}, "want a sequence"),
        ({"context": None}, "want a sequence"),
        ({"elevation_hz": 30}, "50 divided by a whole number"),
        ({"elevation_hz": "a"}, "50 divided by a whole number"),
        ({"width": 10.5}, "width is 10.5, want a whole number, 1 or more"),
        ({"height": 0}, "height is 0, want a whole number, 1 or more"),
        ({"camera": "front", "render_mode": "rgb_array"}, "no camera is called 'front'; the scene has track"),
        ({"task": "fly"}, "it has: goal, figure8"),
        ({"render_mode": "ascii"}, "human, rgb_array"),
        ({"terrain_pool": 0}, "1 or more"),
        ({"difficulty": 2}, "from 0 to 1"),
        ({"terrain_kind": "lava"}, "want one of: "),
        ({"reward_type": "rich"}, "sparse, dense"),
        ({"reward_type": "dense"}, "reward_type is 'dense', which wants goal_conditioned=True"),
        ({"camera": "front"}, "no camera is called 'front'; the scene has track"),
        ({"camera": -1}, "camera is -1, want the name of one, or a free one's lookat"),
        ({"camera": {"trackbody": "nope"}}, "trackbody is 'nope', want the name of a body: world, base"),
        ({"camera": {"trackbody": None}}, "trackbody is None, want the name of a body: world, base"),
        ({"camera": {"distance": "far"}}, "camera's distance is 'far', want a finite number"),
        ({"camera": {"azimuth": np.nan}}, "camera's azimuth is nan, want a finite number"),
        ({"camera": {"lookat": (1, 2)}}, r"camera's lookat is \(1, 2\), want three finite numbers"),
        ({"elevation_hz": True}, "elevation_hz is True, want 50 divided by a whole number"),
        ({"terrain_pool": True}, "terrain_pool is True, want a number of maps"),
        ({"terrain_pool": 2.0}, r"terrain_pool is 2\.0, want a number of maps"),
        ({"terrain_seed": False}, "terrain_seed is False, want a whole number"),
        ({"difficulty": True}, "difficulty is True, want a number"),
        ({"difficulty": np.nan}, "difficulty is nan, want a number from 0 to 1"),
        ({"context": iter(["psi"])}, "context is <list_iterator .*>, want a sequence of: psi, elevation"),
    ],
)
def test_bad_arguments_say_what_is_valid(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        made("nfc_gym/JackalRough-v0", **kwargs)
    with pytest.raises(InputError, match=message.replace("human, ", "")):
        gymnasium.make_vec("nfc_gym/JackalRough-v0", num_envs=2, **(SMALL | kwargs))


def test_numbers_of_any_library_are_numbers() -> None:
    name, plain = "nfc_gym/JackalRough-v0", {"terrain_pool": 4, "terrain_seed": 3, "difficulty": 0.5}
    given = {"terrain_pool": np.int64(4), "terrain_seed": np.uint8(3), "difficulty": np.float32(0.5)}
    camera = {"lookat": np.zeros(3), "distance": np.float32(4), "trackbody": "base"}
    ours = made(name, context=["psi"], elevation_hz=np.float32(25), camera=camera, **given)
    ours.reset(seed=0)
    twin = made(name, context=["psi"], **plain)
    twin.reset(seed=0)
    assert ours.unwrapped.heightfield is twin.unwrapped.heightfield


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
        ({"terrain_id": "x"}, "'x', want a whole number from 0 to 2"),
        ({"terrain_id": np.array([1])}, r"array\(\[1\]\), want a whole number"),
        ({"terrain_id": True}, "True, want a whole number"),
        ({"terrain_id": np.nan}, "nan, want a whole number"),
        ({"heightfield": np.zeros((5, 5))}, r"shape \(5, 5\), want \(256, 256\)"),
        ({"heightfield": np.full((256, 256), np.nan)}, "not finite"),
        ({"heightfield": "hill"}, "heightfield is 'hill', want a number or an array of numbers"),
        ({"terrain_residual": [[0.0], [0.0, 1.0]]}, "terrain_residual is .*, want a number"),
        ({"heightfield": np.full((256, 256), 99.0)}, "-5 to 11 m"),
        ({"heightfield": np.zeros((256, 256)), "terrain_id": 1}, "give one of them"),
    ):
        with pytest.raises(InputError, match=message):
            rough.reset(options=options)
    for index in (1, 1.0, np.int64(1), np.array(1)):
        rough.reset(options={"terrain_id": index})
    with pytest.raises(InputError, match=r"options is \[1\], want None or a mapping with: psi"):
        flat.reset(options=[1])


def test_a_step_before_the_first_reset_is_told() -> None:
    for name in ("nfc_gym/JackalFlat-v0", "nfc_gym/AntFlat-v0"):
        env = made(name).unwrapped
        with pytest.raises(gymnasium.error.ResetNeeded, match="reset before"):
            env.step(np.zeros(env.action_space.shape))


def test_rendering_without_a_mode_warns() -> None:
    env = made("nfc_gym/JackalFlat-v0").unwrapped
    for one_or_two in (env, gymnasium.make_vec("nfc_gym/JackalFlat-v0", num_envs=2)):
        one_or_two.reset()
        with pytest.warns(UserWarning, match="render_mode"):
            assert one_or_two.render() is None


def test_input_errors_are_value_errors() -> None:
    assert issubclass(InputError, ValueError)


@pytest.mark.parametrize(
    "action", [["a", "b"], {}, [1j, 0], [[1], [1, 2]], [10**400, 0], np.zeros(2, "timedelta64[s]")]
)
def test_actions_that_are_no_numbers_are_told(action: Any) -> None:
    for env in (made("nfc_gym/JackalFlat-v0").unwrapped, gymnasium.make_vec("nfc_gym/JackalFlat-v0", num_envs=1)):
        env.reset(seed=0)
        with pytest.raises(InputError, match=r"action is .*, want numbers"):
            env.step(action)


def test_a_value_of_the_wrong_shape_names_the_shapes_that_fit() -> None:
    message = r"psi\['base_mass'\] has shape \(3,\), want \(\)"
    with pytest.raises(InputError, match=message + "$"):
        made("nfc_gym/JackalFlat-v0").reset(options={"psi": {"base_mass": [20.0, 20.0, 20.0]}})
    with pytest.raises(InputError, match=message + r" or \(2,\)$"):
        gymnasium.make_vec("nfc_gym/JackalFlat-v0", num_envs=2).reset(options={"psi": {"base_mass": [20.0] * 3}})


@pytest.mark.parametrize("wrong", ["20", True, [20.0, "x"]])
def test_psi_that_only_looks_like_numbers_is_told(wrong: Any) -> None:
    for env in (made("nfc_gym/JackalFlat-v0"), gymnasium.make_vec("nfc_gym/JackalFlat-v0", num_envs=2)):
        with pytest.raises(InputError, match=r"psi\['base_mass'\] is .*, want a number"):
            env.reset(options={"psi": {"base_mass": wrong}})


def test_a_simulation_that_comes_apart_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """No log in the user's folder, no word on the terminal; what the user listens with is left alone."""
    monkeypatch.chdir(tmp_path)
    single, many = made("nfc_gym/AntFlat-v0"), gymnasium.make_vec("nfc_gym/AntFlat-v0", num_envs=2, nthread=1)
    kept = pickle.loads(pickle.dumps(single.unwrapped))
    kept.reset(seed=0)
    kept = pickle.loads(pickle.dumps(kept))
    single.reset(seed=0)
    many.reset(seed=0)
    for poison in (np.nan, 1e9):
        single.unwrapped.data.qvel[0] = kept.data.qvel[0] = many.unwrapped.batch.bind("qvel")[1, 0] = poison
        for env in (single, kept):
            assert env.step(np.zeros(8))[4]["unstable"]
            env.reset()
        assert many.step(np.zeros((2, 8)))[4]["unstable"].tolist() == [False, True]
        many.step(np.zeros((2, 8)))
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")
