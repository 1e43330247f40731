"""`RandomizePsi`: what is drawn is what is simulated, always from nominal."""

import pickle
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from fakes import FakeEnv, Gaussian, NoModel, roll, same

from nfc_gym.core import Fidelity, InputError
from nfc_gym.wrappers import ApplyEffects, Hallucinate, RandomizePsi, VectorRandomizePsi
from nfc_gym.wrappers.source import Draws


def test_a_drawn_mass_is_in_the_model_and_inertia_follows() -> None:
    env = RandomizePsi(FakeEnv(), {"cube": (2.0, 4.0)})
    inertia = FakeEnv().model.body("cube").inertia.copy()
    masses = []
    for seed in range(20):
        env.reset(seed=seed)
        body = env.unwrapped.model.body("cube")
        assert body.mass[0] == env.psi[0]
        np.testing.assert_allclose(body.inertia, inertia * env.psi[0])  # 1 kg at first
        assert env.unwrapped.model.body_subtreemass[0] == pytest.approx(env.psi[0] + 0.5)
        masses.append(env.psi[0])
    assert 2 <= min(masses) < 2.4 < 3.6 < max(masses) <= 4
    env.reset(seed=3)
    assert env.psi[0] == masses[3]


def test_fractions_lie_strictly_inside_the_prior_around_nominal() -> None:
    space = [{"name": "m", "field": "body_mass", "of": ["cube"], "low": 0.5, "high": 5.0}]
    env = RandomizePsi(FakeEnv(), 0.5, space)
    drawn = np.array([(env.reset(seed=s), env.psi[0])[1] for s in range(200)])
    assert 0.75 <= drawn.min() < 0.78
    assert 2.9 < drawn.max() <= 3.0


def test_names_of_bodies_have_a_prior_of_half_to_one_and_a_half() -> None:
    env = RandomizePsi(FakeEnv(), space=["cube", "pole"])
    assert env.psi_space.names == ("cube", "pole")
    np.testing.assert_allclose(env.psi_space.low, [0.5, 0.25])
    np.testing.assert_allclose(env.psi_space.high, [1.5, 0.75])


def test_samples_posteriors_and_files(tmp_path: Path) -> None:
    samples = np.random.default_rng(0).uniform(0.6, 1.4, (30, 1))
    Fidelity(psi=samples).save(tmp_path / "psi.npz")
    for source in (samples, Fidelity(psi=samples), tmp_path / "psi.npz"):
        env = RandomizePsi(FakeEnv(), source, ["cube"])
        drawn = {float((env.reset(), env.psi)[1][0]) for _ in range(60)}
        assert drawn <= set(samples[:, 0])
        assert len(drawn) > 15
    env = RandomizePsi(FakeEnv(), Gaussian("psi", np.array([1.0]), 0.05), ["cube"])
    drawn = np.array([(env.reset(), env.psi)[1][0] for _ in range(300)])
    assert abs(drawn.mean() - 1) < 0.01 < drawn.std() < 0.06


def test_options_override_the_draw() -> None:
    env = RandomizePsi(FakeEnv(), space=["cube", "pole"])
    env.reset(options={"psi": {"cube": 1.25}})
    np.testing.assert_array_equal(env.psi, [1.25, 0.5])
    assert env.unwrapped.model.body("cube").mass[0] == 1.25


def test_an_own_space_is_used_and_read_back() -> None:
    import nfc_gym  # noqa: F401 (registers)

    env = RandomizePsi(gym.make("nfc_gym/JackalFlat-v0"), 0.5)
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(env.unwrapped.psi, env.psi)
    expected = np.clip(env.psi_space.normalise(env.psi), -1, 1)
    np.testing.assert_allclose(observation["psi"], expected, rtol=1e-6)
    env.reset(options={"psi": env.psi_space.nominal})
    np.testing.assert_array_equal(env.unwrapped.psi, env.psi_space.nominal)


def test_another_space_than_the_environments_own_is_simulated_too() -> None:
    """On top of the environment's own psi, once, whatever stands around."""
    load = {"family": "payload", "where": "base", "parameters": {"mass": 2.0, "x": 0.0, "y": 0.0, "z": 0.0}}
    gravity = {"name": "gravity", "field": "opt.gravity[2]", "unit": "m/s^2", "low": -12.0, "high": -8.0}
    made = gym.make("nfc_gym/JackalFlat-v0")
    heavy = made.unwrapped.psi_space.vector({"base_mass": 20.0})
    env = RandomizePsi(made, space=["base"])
    for seed in range(2):
        env.reset(seed=seed, options=None)
        assert env.unwrapped.model.body("base").mass[0] == env.psi[0] != made.unwrapped.psi_space.nominal[0]
    env = ApplyEffects(RandomizePsi(gym.make("nfc_gym/JackalFlat-v0"), space=[gravity]), [load])
    for seed in range(2):
        env.reset(seed=seed)
        assert env.unwrapped.model.opt.gravity[2] == env.get_wrapper_attr("psi")[0] != -9.81
        assert env.unwrapped.model.body("base").mass[0] == pytest.approx(made.unwrapped.psi_space.nominal[0] + 2)
    env = Hallucinate(gym.make("nfc_gym/JackalFlat-v0"), heavy[:1] * [[0.9], [1.0], [1.1]], space=["base"])
    env.reset(seed=0)
    env.step(np.ones(3, np.float32))
    psi = env.fidelity.psi
    assert psi is not None
    assert env.unwrapped.model.body("base").mass[0] == psi[0] > 20


def test_options_that_are_refused_change_nothing() -> None:
    env = RandomizePsi(gym.make("nfc_gym/JackalFlat-v0"))
    env.reset(seed=0)
    before = env.psi
    with pytest.raises(InputError, match="want a dict"):
        env.reset(options=["psi"])  # type: ignore[arg-type]
    with pytest.raises(InputError, match="base_mass"):
        env.reset(options={"psi": {"base_mass": -1}})
    np.testing.assert_array_equal(env.psi, before)


def test_nominal_is_no_wrapper_bit_for_bit() -> None:
    mass = float(gym.make("Ant-v5").unwrapped.model.body("torso").mass[0])
    same(roll(RandomizePsi(gym.make("Ant-v5"), {"torso": (mass, mass)}), 5), roll(gym.make("Ant-v5"), 5))


def test_spec_and_pickle(tmp_path: Path) -> None:
    Fidelity(psi=np.array([[0.2], [0.3]])).save(tmp_path / "psi.npz")
    for arguments in (
        {"distribution": {"torso": [0.1, 0.4]}},
        {"distribution": tmp_path / "psi.npz", "space": ["torso"]},
    ):
        env = RandomizePsi(gym.make("Ant-v5"), **arguments)
        expected = roll(env, 4)
        same(roll(pickle.loads(pickle.dumps(env)), 4), expected)
        remade = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
        same(roll(remade, 4), expected)
        assert remade.spec.additional_wrappers == env.spec.additional_wrappers


@pytest.mark.parametrize(
    ("distribution", "space", "message"),
    [
        (1.0, None, "psi_space"),
        (0.0, ["cube"], r"\(0, 1\]"),
        ({"cub": (0, 1)}, None, "cube, pole"),
        ({"cube": (2, 1)}, None, "low <= high"),
        ({"elbow": (1, 2)}, ["cube"], "cube"),
        (np.ones((3, 2)), ["cube"], r"\(1,\)"),
        (np.array([np.nan]), ["cube"], "nan"),
        ("psi.npz", ["cube"], "no such file"),
        ([[object()]], ["cube"], "posterior"),
        (None, ["cube"], r"posterior with sample\(n, rng\), an array of numbers or a path, got None"),
        (np.ones(1, complex), ["cube"], "an array of numbers or a path, got array"),
        (True, ["cube"], r"lies in \(0, 1\], got True"),
        (1.0, 5, "space is 5; want a ParameterSpace, .* whose masses vary: cube, pole"),
        (1.0, {"cube": 1}, "space is {'cube': 1}; want a ParameterSpace"),
    ],
)
def test_bad_input_is_refused_by_name(distribution, space, message: str) -> None:
    with pytest.raises(InputError, match=message):
        RandomizePsi(FakeEnv(), distribution, space)


@pytest.mark.parametrize(
    ("distribution", "message"),
    [
        ({"base_mass": (-5, 10)}, "'base_mass': a mass must be positive, got -5 kg"),
        ({"front_left_wheel_friction": (-0.1, 1)}, "'front_left_wheel_friction' is -0.1, want 0 or more"),
        ({"front_left_wheel_restitution": (0.5, 2)}, "'front_left_wheel_restitution' is 2, want a number from 0 to 1"),
    ],
)
def test_ranges_that_reach_the_impossible_are_refused(distribution, message: str) -> None:
    for wrapper, env in (
        (RandomizePsi, gym.make("nfc_gym/JackalFlat-v0")),
        (VectorRandomizePsi, gym.make_vec("nfc_gym/JackalFlat-v0", num_envs=2)),
    ):
        with pytest.raises(InputError, match=message):
            wrapper(env, distribution)
        wrapper(env, {"base_mass": (5, 80)}).reset()  # beyond the prior


def test_impossible_values_are_refused_of_environments_of_others() -> None:
    space = [{"name": "grip", "field": "geom_friction[0]", "of": ["cube"], "low": 0.1, "high": 2}]
    with pytest.raises(InputError, match="'grip' is -1, want 0 or more"):
        RandomizePsi(FakeEnv(), space=space).reset(options={"psi": {"grip": -1}})
    with pytest.raises(InputError, match="'grip' is -2, want 0 or more"):
        RandomizePsi(FakeEnv(), np.array([-2.0]), space).reset()
    with pytest.raises(InputError, match=r"psi\['grip'\] is 'firm'"):
        RandomizePsi(FakeEnv(), space=space).reset(options={"psi": {"grip": "firm"}})


def test_an_environment_without_mujoco_is_refused() -> None:
    with pytest.raises(InputError, match="NoModel"):
        RandomizePsi(NoModel(), 1.0, ["cube"])
    with pytest.raises(InputError, match="mass"):
        RandomizePsi(FakeEnv(), np.array([-1.0]), ["cube"]).reset()


def test_sources_that_give_no_samples_are_told() -> None:
    class Arrays:
        def sample(self, n, rng):
            return np.zeros((n, 1))

    class One:
        def sample(self, n, rng):
            return Fidelity(psi=np.ones((1, 1)))

    with pytest.raises(InputError, match=r"the source holds no sample, \(0, 1\)"):
        RandomizePsi(FakeEnv(), np.zeros((0, 1)), space=["cube"])
    with pytest.raises(InputError, match=r"must return a Fidelity, such as Fidelity\(psi=array\), got ndarray"):
        RandomizePsi(FakeEnv(), Arrays(), space=["cube"])
    with pytest.raises(InputError, match="the source gave 1 samples of psi where 3 were asked for"):
        Draws(One(), "psi", "RandomizePsi").draw(3, np.random.default_rng(0))


@pytest.mark.parametrize("wrong", [{"name": "m"}, {"name": "m", "field": "body_mass", "of": "cube", "size": 3}])
def test_a_table_that_is_no_parameter_is_told(wrong) -> None:
    with pytest.raises(InputError, match="is no parameter: want a table of name, field, and perhaps of, unit"):
        RandomizePsi(FakeEnv(), 0.5, space=[wrong])


@pytest.mark.parametrize("many", [False, True])
def test_a_psi_of_none_is_not_given(many: bool) -> None:
    shown = []
    for options in (None, {"psi": None, "psi_belief": None}):
        if many:
            env: Any = VectorRandomizePsi(gym.make_vec("nfc_gym/JackalFlat-v0", num_envs=2, context=["psi"]), 0.5)
        else:
            env = RandomizePsi(gym.make("nfc_gym/JackalFlat-v0", context=["psi"]), 0.5)
        env.reset(seed=0, options=options)
        np.testing.assert_array_equal(env.psi, env.unwrapped.psi)
        shown.append(env.psi)
    np.testing.assert_array_equal(shown[1], shown[0])
    assert (shown[0][..., 0] != env.psi_space.nominal[0]).all()
