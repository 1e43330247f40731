"""`Hallucinate`: the world is mean + beta L h; psi and ground hold for an episode."""

import pickle
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from fakes import FakeEnv, NoModel, same
from scipy.special import ndtr, ndtri

import nfc_gym  # noqa: F401 (registers the ids)
from nfc_gym.core import Fidelity, InputError
from nfc_gym.physics.parameters import Parameter, ParameterSpace
from nfc_gym.wrappers import (
    ApplyEffects,
    Hallucinate,
    PerturbSignals,
    RandomizePsi,
    ResidualDynamics,
    VectorHallucinate,
)
from nfc_gym.wrappers.belief import Belief

SPACE = ParameterSpace(
    FakeEnv().model,
    [
        Parameter("cube", "body_mass", ("cube",), "kg", 0.5, 2.0),
        Parameter("pole", "body_mass", ("pole",), "kg", 0.2, 1.0),
    ],
)


def _samples(n: int = 4000) -> Fidelity:
    """Psi whose probit is Gaussian with known mean and covariance, and a residual that goes with it."""
    rng = np.random.default_rng(0)
    z = rng.multivariate_normal([0.3, -0.2, 0.05], [[0.16, 0.06, 0.01], [0.06, 0.09, 0], [0.01, 0, 0.01]], n)
    psi = SPACE.low + (SPACE.high - SPACE.low) * ndtr(z[:, :2])
    delta = np.zeros((n, 7))
    delta[:, 0] = z[:, 2]
    return Fidelity(psi, delta)


def test_the_mean_and_one_standard_deviation() -> None:
    belief = Belief(_samples(), SPACE, 0)
    assert (belief.size, belief.held) == (9, 2)
    low, span = SPACE.low, SPACE.high - SPACE.low

    def at(*h: float, beta: float = 1.0) -> np.ndarray:
        found = belief.at(np.array([*h, *np.zeros(9 - len(h))]), beta)
        assert found.psi is not None
        return ndtri((found.psi - low) / span)

    np.testing.assert_allclose(at(), [0.3, -0.2], atol=0.02)
    # The columns of the Cholesky factor of [[0.16, 0.06], [0.06, 0.09]] are (0.4, 0.15) and (0, sqrt(0.0675)).
    np.testing.assert_allclose(at(1) - at(), [0.4, 0.15], atol=0.02)
    np.testing.assert_allclose(at(0, -1) - at(), [0, -np.sqrt(0.0675)], atol=0.02)
    np.testing.assert_allclose(at(1, beta=2.0) - at(), [0.8, 0.3], atol=0.04)
    np.testing.assert_allclose(at(7), at(1))  # h lies in [-1, 1]
    outer = belief.at(np.ones(9), 50.0).psi
    assert outer is not None
    assert (outer >= low).all()
    assert (outer <= SPACE.high).all()


def test_the_covariance_of_what_h_leads_to_is_the_posteriors() -> None:
    """With standard normal h (inside the box of a small beta) the worlds have the samples' spread."""
    samples = _samples()
    belief = Belief(samples, SPACE, 0)
    np.testing.assert_allclose(belief.root @ belief.root.T, np.cov(_joint(samples), rowvar=False), atol=1e-5)
    assert (np.triu(belief.root, 1) == 0).all()
    np.testing.assert_array_equal(belief.root[3:], 0)  # entries of delta_s that do not vary


def _joint(samples: Fidelity) -> np.ndarray:
    assert samples.psi is not None
    assert samples.delta_s is not None
    return np.concatenate([ndtri((samples.psi - SPACE.low) / (SPACE.high - SPACE.low)), samples.delta_s], 1)


def test_modes_of_the_ground_are_its_principal_ones() -> None:
    rng = np.random.default_rng(1)
    first, second = np.outer(np.ones(5), np.linspace(-1, 1, 6)), np.outer(np.linspace(-1, 1, 5), np.ones(6))
    maps = 0.3 + rng.normal(size=(500, 1, 1)) * 0.2 * first + rng.normal(size=(500, 1, 1)) * 0.05 * second
    belief = Belief(Fidelity(delta_e=maps), None, 2)
    assert (belief.size, belief.held) == (2, 2)
    middle, far = (belief.at(np.array(h), 1.0).delta_e for h in ([0.0, 0.0], [1.0, 0.0]))
    assert middle is not None
    assert far is not None
    np.testing.assert_allclose(middle, 0.3, atol=0.05)
    np.testing.assert_allclose(abs(far - middle), 0.2 * abs(first), atol=0.02)


def _env(**kwargs) -> Hallucinate:
    return Hallucinate(FakeEnv(), _samples(), space=SPACE, **kwargs)


def test_the_action_is_its_own_part_and_h() -> None:
    env = _env()
    assert env.action_space.shape == (1 + 2 + 7,)
    np.testing.assert_array_equal(env.action_space.low, [-30, *[-1] * 9])
    assert env.action_space.dtype == env.env.action_space.dtype


def test_psi_holds_for_an_episode_and_the_residual_follows_each_action() -> None:
    env = _env(beta=1.5)
    env.reset(seed=0)
    model, belief = env.unwrapped.model, env.belief
    masses = lambda: [model.body(b).mass[0] for b in ("cube", "pole")]  # noqa: E731
    np.testing.assert_allclose(masses(), belief.at(np.zeros(9), 1.5).psi)
    h = np.array([0.5, -1.0, 1.0, *np.zeros(6)])
    env.step(np.concatenate([[0.0], h]))
    world = belief.at(h, 1.5)
    np.testing.assert_allclose(masses(), world.psi)
    assert world.delta_s is not None
    assert env.unwrapped.data.qvel[0] == pytest.approx(world.delta_s[0], rel=1e-9)
    speed = env.unwrapped.data.qvel[0]
    env.step(np.concatenate([[0.0], -h]))
    np.testing.assert_allclose(masses(), world.psi)
    later = belief.at(np.array([0.5, -1.0, -1.0, *np.zeros(6)]), 1.5)
    assert later.delta_s is not None
    assert env.unwrapped.data.qvel[0] - speed == pytest.approx(later.delta_s[0], rel=1e-9)
    env.reset(seed=0)
    np.testing.assert_allclose(masses(), belief.at(np.zeros(9), 1.5).psi)


def test_effects_stay_on_top_of_the_psi_that_was_chosen() -> None:
    payload = [{"family": "armature", "where": "hinge", "parameters": {"inertia": 0.01}}]
    for env in (ApplyEffects(_env(), payload), Hallucinate(ApplyEffects(FakeEnv(), payload), _samples(), space=SPACE)):
        env.reset(seed=0)
        env.step(np.concatenate([[0.0], np.ones(9)]))
        assert env.unwrapped.model.dof_armature[6] == pytest.approx(0.01)
        assert env.unwrapped.model.body("cube").mass[0] > 1.3


def test_ground_is_chosen_by_the_first_action_from_the_same_start() -> None:
    rng = np.random.default_rng(0)
    env = gym.make("nfc_gym/JackalRough-v0", terrain_pool=2, difficulty=0.0)
    space = env.unwrapped.psi_space
    samples = Fidelity(
        psi=space.nominal * (1 + 0.02 * rng.standard_normal((60, len(space)))),
        delta_e=0.05 * rng.standard_normal((60, 1, 1)) * np.ones((60, 256, 256)),
    )
    env = Hallucinate(env, samples, modes=1)
    base = env.unwrapped
    for seed in (3, None, None):
        before, _ = env.reset(seed=seed)
        start, ground, seen = base.data.qpos[:2].copy(), base.heightfield.heights, base.perceived.heights
        h = np.zeros(env.action_space.shape, np.float32)
        h[2 + len(space)] = 1
        after, *_ = env.step(h)
        np.testing.assert_allclose(base.data.qpos[:2], start, atol=0.02)
        risen = base.heightfield.heights - ground
        assert np.ptp(risen) < 1e-6
        assert abs(abs(risen[0, 0]) - 0.05) < 0.02
        assert env.fidelity.psi is not None
        np.testing.assert_allclose(base.psi, env.fidelity.psi)
        # The agent is told the mean.
        np.testing.assert_array_equal(before["psi"], after["psi"])
        # And sees the ground as before.
        np.testing.assert_array_equal(base.perceived.heights, seen)


def test_the_wrappers_beneath_begin_again_from_the_same_draws_too() -> None:
    rng = np.random.default_rng(0)
    env = gym.make("nfc_gym/JackalRough-v0", terrain_pool=2, context=["psi"])
    residual = ResidualDynamics(env, 0.01 * rng.standard_normal((9, 15)))
    signals = PerturbSignals(residual, {"proprio": {"bias_sd": 0.5, "sd": 0.1}})
    env = Hallucinate(signals, Fidelity(delta_e=0.001 * rng.standard_normal((16, 256, 256))), modes=2, samples=16)
    biases = []
    for seed in (None, 0, None, None):
        env.reset(seed=seed)
        before = signals.channels["proprio"].total.copy(), residual.injection.bias.copy()
        env.step(np.zeros(env.action_space.shape))
        same(before, (signals.channels["proprio"].total, residual.injection.bias))
        biases.append(before[0][0])
    assert len(set(biases)) == 4, "each episode has its own"


def test_spec_and_pickle(tmp_path: Path) -> None:
    masses = np.random.default_rng(0).uniform(0.2, 0.4, (50, 1))
    Fidelity(psi=masses, delta_s=0.01 * masses * np.ones(14)).save(tmp_path / "posterior.npz")
    env = Hallucinate(gym.make("Ant-v5"), tmp_path / "posterior.npz", space=["torso"])

    def run(each: gym.Env) -> list:
        out = [each.reset(seed=1)[0]]
        actions = np.random.default_rng(0).uniform(-1, 1, (5, 8 + 15))
        return out + [each.step(a)[0] for a in actions]

    expected = run(env)
    same(run(pickle.loads(pickle.dumps(env))), expected)
    same(run(gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))), expected)


def test_bad_input_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="MuJoCo"):
        Hallucinate(NoModel(), _samples())
    with pytest.raises(InputError, match="sample"):
        Hallucinate(FakeEnv(), object())  # type: ignore[arg-type]
    with pytest.raises(InputError, match="psi_space"):
        Hallucinate(FakeEnv(), _samples())
    with pytest.raises(InputError, match="2 entries; want cube"):
        Hallucinate(FakeEnv(), _samples(), space=["cube"])
    with pytest.raises(InputError, match="two samples"):
        Hallucinate(FakeEnv(), Fidelity(delta_s=np.zeros(7)), samples=1)
    for samples in ("a", 2.5, -3):
        with pytest.raises(InputError, match=f"samples is {samples!r}"):
            Hallucinate(FakeEnv(), Fidelity(delta_s=np.zeros(7)), samples=samples)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="component 1 of delta_s: want"):
        Hallucinate(FakeEnv(), Fidelity(delta_s=np.zeros(2)), components=[1, 2])  # type: ignore[list-item]
    with pytest.raises(InputError, match="nv = 7"):
        Hallucinate(FakeEnv(), Fidelity(delta_s=np.zeros(5)))
    with pytest.raises(InputError, match="force, state"):
        Hallucinate(FakeEnv(), Fidelity(delta_s=np.zeros(7)), mode="x")  # type: ignore[arg-type]
    for beta in ("x", -1, np.nan):
        with pytest.raises(InputError, match=f"beta is {beta!r}"):
            Hallucinate(FakeEnv(), Fidelity(delta_s=np.zeros(7)), beta=beta)  # type: ignore[arg-type]


def test_orders_that_cannot_work_are_refused_by_name() -> None:
    with pytest.raises(InputError, match="psi is written by"):
        Hallucinate(RandomizePsi(FakeEnv(), space=["cube"]), _samples(), space=SPACE)
    with pytest.raises(InputError, match="psi is written by"):
        RandomizePsi(_env(), space=["cube"])
    Hallucinate(RandomizePsi(FakeEnv(), space=["cube"]), Fidelity(delta_s=np.zeros(7)))
    with pytest.raises(InputError, match="put Hallucinate around PerturbSignals"):
        PerturbSignals(_env(), {"action": {"sd": 0.1}})


def test_an_array_is_draws_of_psi() -> None:
    draws = _samples(50).psi
    assert draws is not None
    env, other = (Hallucinate(FakeEnv(), source, space=SPACE) for source in (draws, Fidelity(draws)))
    np.testing.assert_array_equal(env.belief.mean, other.belief.mean)
    assert env.action_space.shape == (3,)
    with pytest.raises(InputError, match=r"3 entries; want cube, pole"):
        Hallucinate(FakeEnv(), np.ones((50, 3)), space=SPACE)


LOAD = {"family": "payload", "where": "base", "parameters": {"mass": 5.0, "x": 0.0, "y": 0.0, "z": 0.1}}
GROUND = 0.05 * np.random.default_rng(0).standard_normal((8, 1, 1)) * np.tile(np.linspace(-1, 1, 256), (256, 1))


def _rough() -> gym.Env:
    return gym.make("nfc_gym/JackalRough-v0", context=["psi"], terrain_pool=1)


def test_model_effects_around_a_chosen_ground_outlast_the_first_step() -> None:
    env = ApplyEffects(Hallucinate(_rough(), Fidelity(delta_e=GROUND), samples=8), [LOAD])
    model = env.unwrapped.model
    nominal = model.body("base").mass[0]
    env.reset(seed=0)
    for _ in range(2):
        assert model.body("base").mass[0] == pytest.approx(nominal + 5)
        env.step(np.array([0, 0, 1], np.float32))
    assert model.body("base").mass[0] == pytest.approx(nominal + 5)


@pytest.mark.parametrize("many", [False, True])
def test_the_environment_reads_back_the_psi_that_was_chosen(many: bool) -> None:
    env = (
        gym.make_vec("nfc_gym/JackalFlat-v0", num_envs=2, context=["psi"])
        if many
        else gym.make("nfc_gym/JackalFlat-v0", context=["psi"])
    )
    base, space = env.unwrapped, env.unwrapped.psi_space
    draws = np.random.default_rng(0).uniform(space.low, space.high, (64, len(space)))
    env = (VectorHallucinate if many else Hallucinate)(env, draws)
    told = env.reset(seed=0)[0]["psi"]
    mean = base.psi
    shown = env.step(np.ones(env.action_space.shape, np.float32))[0]["psi"]
    assert env.fidelity.psi is not None
    np.testing.assert_array_equal(base.psi, env.fidelity.psi)
    mass = base.batch.expand("body_mass")[:, 1] if many else base.model.body_mass[1]
    np.testing.assert_array_equal(mass, base.psi[..., 0])
    assert (base.psi != mean).any()
    np.testing.assert_array_equal(shown, told)  # the agent still believes the mean


def test_a_belief_says_what_it_is_of() -> None:
    assert repr(Belief(_samples(50), SPACE, 0)) == "Belief(psi 2, delta_s 7; held 2 of 9)"
