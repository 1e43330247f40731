"""Twins around vector environments: row i with seed s + i is the single environment with that seed, bit for bit."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from fakes import same

import nfc_gym  # noqa: F401 (registers the ids)
from nfc_gym.core import Fidelity, InputError
from nfc_gym.terrain.perceived import PerceivedMap
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
    VectorApplyEffects,
    VectorHallucinate,
    VectorMonitorAnomaly,
    VectorPerceiveTerrain,
    VectorPerturbSignals,
    VectorRandomizePsi,
    VectorRecordLog,
    VectorResidualDynamics,
    VectorResidualTerrain,
)

N, STEPS, END = 3, 14, 5
ID = "nfc_gym/JackalFlat-v0"
NV = 10
SLIP = {"family": "slip", "where": "ground", "parameters": {"lateral": 0.4, "longitudinal": 0.1, "creep": 2.0}}
DELAY = {"family": "delay", "where": "front_left", "parameters": {"delay": 0.017}}
HEAT = {
    "family": "thermal",
    "where": "rear_right",
    "parameters": {"fade": 0.4, "time_constant": 0.1, "reference": 10.0},
}
DRY = {"family": "coulomb", "where": "rear_left_wheel", "parameters": {"level": 0.3}}
LOAD = {"family": "payload", "where": "base", "parameters": {"mass": 3.0, "x": 0.1, "y": 0.0, "z": 0.1}}
MEMORIES = [
    {"family": "hysteresis", "where": "rear_left_wheel", "parameters": {"level": 0.5, "transition": 0.3}},
    {"family": "backlash", "where": "front_right_wheel", "parameters": {"gap": 0.2, "rotor": 0.005}},
    {
        "family": "friction_patch",
        "where": "ground",
        "parameters": {"lost": 0.7, "x": 0.1, "y": 0.1, "radius_x": 0.3, "radius_y": 0.4},
    },
    {"family": "compliance", "where": "ground", "parameters": {"softness": 0.5, "damping": 0.2}},
    {"family": "sinkage", "where": "ground", "parameters": {"depth": 0.004, "resistance": 0.1}},
    {
        "family": "gust",
        "where": "base",
        "parameters": {"push_x": 0.0, "push_y": 9.0, "push_z": 0.0, "start": 0.03, "length": 0.06},
    },
]
EFFECTS = [SLIP, DELAY, HEAT, DRY, LOAD]
BIAS = 0.02 * np.arange(1.0, NV + 1)

STACKS: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "effects": (lambda e: ApplyEffects(e, EFFECTS), lambda e: VectorApplyEffects(e, EFFECTS)),
    "memory": (lambda e: ApplyEffects(e, MEMORIES), lambda e: VectorApplyEffects(e, MEMORIES)),
    "force": (lambda e: ResidualDynamics(e, BIAS), lambda e: VectorResidualDynamics(e, BIAS)),
    "state": (
        lambda e: ResidualDynamics(e, BIAS, mode="state"),
        lambda e: VectorResidualDynamics(e, BIAS, mode="state"),
    ),
    "both": (
        lambda e: ResidualDynamics(ApplyEffects(e, EFFECTS), BIAS),
        lambda e: VectorResidualDynamics(VectorApplyEffects(e, EFFECTS), BIAS),
    ),
    "psi": (
        lambda e: ApplyEffects(RandomizePsi(e, {"base_mass": [16.5, 16.5]}), [LOAD, DRY]),
        lambda e: VectorApplyEffects(VectorRandomizePsi(e, {"base_mass": [16.5, 16.5]}), [LOAD, DRY]),
    ),
}


def _vector(**kwargs: Any) -> gym.vector.VectorEnv:
    return gym.make_vec(ID, num_envs=N, max_episode_steps=END, context=["psi"], nthread=2, **kwargs)


def _actions() -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (STEPS, N, 2))


@pytest.mark.parametrize("stack", STACKS)
@pytest.mark.parametrize("mode", list(gym.vector.AutoresetMode))
def test_rows_are_single_environments(stack: str, mode: gym.vector.AutoresetMode) -> None:
    wrap, twin = STACKS[stack]
    envs, actions = twin(_vector(autoreset_mode=mode)), _actions()
    many = [envs.reset(seed=11)[0]["proprio"]]
    for k in range(STEPS):
        observation, _, ended, truncated, info = envs.step(actions[k])
        if mode is gym.vector.AutoresetMode.SAME_STEP and (ended | truncated).any():
            many.append(np.stack([f["proprio"] for f in info["final_obs"]]))
        many.append(observation["proprio"])
        if mode is gym.vector.AutoresetMode.DISABLED and truncated.any():
            many.append(envs.reset(options={"reset_mask": truncated})[0]["proprio"])
    for row in range(N):
        env = wrap(gym.make(ID, max_episode_steps=END, context=["psi"]))
        one = [env.reset(seed=11 + row)[0]["proprio"]]
        truncated = False
        for k in range(STEPS):
            if truncated and mode is gym.vector.AutoresetMode.NEXT_STEP:
                one.append(env.reset()[0]["proprio"])
                truncated = False
                continue
            observation, _, _, truncated, _ = env.step(actions[k, row])
            one.append(observation["proprio"])
            if truncated and mode is not gym.vector.AutoresetMode.NEXT_STEP:
                one.append(env.reset()[0]["proprio"])
        np.testing.assert_array_equal(np.array(many)[:, row], one)


@pytest.mark.parametrize("stack", STACKS)
def test_each_stack_does_something(stack: str) -> None:
    """And so the comparison above means something."""
    envs, bare = STACKS[stack][1](_vector()), _vector()
    shown = []
    for each in (envs, bare):
        each.reset(seed=11)
        for action in _actions()[:4]:
            observation = each.step(action)[0]["proprio"]
        shown.append(observation)
    assert (shown[0] != shown[1]).any(1).all()


def test_own_values_that_cannot_be_are_refused() -> None:
    light = [[1.0, 0.0, 0.0, 0.0], [-100.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]]
    with pytest.raises(InputError, match=r"payload:base.*mass is -100 kg; it must be"):
        VectorApplyEffects(_vector(), [LOAD], values=[light])


def test_null_is_no_wrapper_bit_for_bit() -> None:
    nothing = [{**DRY, "parameters": {"level": 0.0}}, {**DELAY, "parameters": {"delay": 0.0}}]
    mass = float(_vector().unwrapped.psi_space.nominal[0])
    twins = [
        lambda e: VectorApplyEffects(e, nothing),
        lambda e: VectorResidualDynamics(e, np.zeros(NV)),
        lambda e: VectorResidualDynamics(e, np.zeros(2 * NV), mode="state"),
        lambda e: VectorRandomizePsi(e, {e.unwrapped.psi_space.names[0]: (mass, mass)}),
        lambda e: VectorPerturbSignals(e, {"proprio": {"sd": 0.0}, "action": {"bias": 0.0}}),
    ]
    expected = _roll(_vector())
    together = _vector()
    for twin in twins:
        same(_roll(twin(_vector())), expected)
        together = twin(together)
    same(_roll(together), expected)


def _roll(envs: gym.vector.VectorEnv) -> list:
    out: list = [envs.reset(seed=5)[0]]
    for action in _actions():
        observation, reward, ended, truncated, _ = envs.step(action)
        out.append((observation, reward, ended, truncated))
    return out


@pytest.mark.parametrize("mode", list(gym.vector.AutoresetMode))
def test_the_mode_of_autoreset_is_the_environments(mode: gym.vector.AutoresetMode) -> None:
    """TorchRL asks for it."""
    envs = gym.wrappers.vector.ClipReward(_vector(autoreset_mode=mode), -1, 1)  # which does not say it
    assert VectorPerturbSignals(envs, {}).autoreset_mode is mode


def test_psi_is_drawn_for_each_episode_of_each_row() -> None:
    envs = VectorRandomizePsi(_vector(), 0.5)
    envs.reset(seed=1)
    first = envs.psi
    assert len(np.unique(first[:, 0])) == N
    space = envs.psi_space
    assert (first >= space.nominal - 0.5 * (space.nominal - space.low) - 1e-12).all()
    for _ in range(END + 1):
        observation, *_ = envs.step(np.zeros((N, 2)))
    assert (envs.psi[:, 0] != first[:, 0]).all()
    np.testing.assert_allclose(observation["psi"], np.clip(space.normalise(envs.psi), -1, 1), rtol=1e-5)
    envs.reset(seed=1)
    np.testing.assert_array_equal(envs.psi, first)
    envs.reset(options={"psi": space.nominal})
    np.testing.assert_array_equal(envs.psi, np.tile(space.nominal, (N, 1)))


def test_a_posterior_gives_each_row_a_bias_of_its_own() -> None:
    samples = np.random.default_rng(0).normal(size=(40, NV))
    envs = VectorResidualDynamics(_vector(), samples, covariance=np.full(NV, 1e-4))
    envs.reset(seed=2)
    first = envs.delta_s
    assert all((samples == row).all(1).any() for row in first)
    once = _roll(envs)
    same(_roll(envs), once)


def test_residual_terrain_reaches_the_simulator_but_not_the_map() -> None:
    arguments = {"num_envs": N, "terrain_pool": 2, "difficulty": 0.3, "max_episode_steps": 6}
    bare = gym.make_vec("nfc_gym/JackalRough-v0", **arguments)
    seen, _ = bare.reset(seed=3)
    null = VectorResidualTerrain(gym.make_vec("nfc_gym/JackalRough-v0", **arguments), np.zeros((256, 256)))
    same(null.reset(seed=3)[0], seen)
    envs = VectorResidualTerrain(gym.make_vec("nfc_gym/JackalRough-v0", **arguments), np.full((256, 256), 0.2))
    told, _ = envs.reset(seed=3)
    rise = (envs.unwrapped.batch.qpos - bare.unwrapped.batch.qpos)[:, 2]
    np.testing.assert_allclose(rise, 0.2, atol=1e-6)
    np.testing.assert_allclose(told["elevation"] + 0.2, seen["elevation"], atol=1e-5)
    both = VectorApplyEffects(VectorResidualDynamics(envs, BIAS), [SLIP, DELAY])
    for _ in range(2):  # the batch is another one after the first reset
        both.reset(seed=3)
        for _ in range(8):
            observation, *_ = both.step(np.full((N, 2), 0.5))
    assert np.isfinite(observation["proprio"]).all()
    two = VectorResidualTerrain(
        gym.make_vec("nfc_gym/JackalRough-v0", **arguments), np.arange(5.0)[:, None, None] * np.ones((256, 256))
    )
    drawn = set()
    for seed in (0, None, None, None):
        two.reset(seed=seed)
        drawn |= set(two.delta_e[:, 0, 0])
    assert len(drawn) > 2


def test_rows_see_with_cameras_of_their_own() -> None:
    arguments = {"terrain_pool": 2, "difficulty": 0.3}
    envs = VectorPerceiveTerrain(gym.make_vec("nfc_gym/JackalRough-v0", num_envs=2, max_episode_steps=4, **arguments))
    observation, _ = envs.reset(seed=3)
    assert observation["elevation"].shape == (2, 128, 128)
    assert observation in envs.observation_space
    for _ in range(6):
        observation, *_ = envs.step(np.zeros((2, 2)))
    assert envs.valid.any((1, 2)).all()
    assert (observation["elevation"][0] != observation["elevation"][1]).any()


def test_a_row_sees_what_it_would_see_if_no_other_were_reset() -> None:
    seen = []
    for part in (False, True):
        made = gym.make_vec("nfc_gym/JackalRough-v0", num_envs=3, autoreset_mode="Disabled", terrain_pool=2)
        envs, rng, maps = VectorPerceiveTerrain(made), np.random.default_rng(0), []
        envs.reset(seed=0)
        for t in range(16):
            if part and t == 7:
                again, _ = envs.reset(options={"reset_mask": np.array([False, True, False])})
                same(again["elevation"][[0, 2]], maps[-1])
            maps.append(envs.step(rng.uniform(-1, 1, (3, 2)))[0]["elevation"][[0, 2]])
        seen.append(maps)
    same(*seen)


@pytest.mark.parametrize("mode", [None, *gym.vector.AutoresetMode])
def test_a_simulation_that_comes_apart_ends_an_episode_and_not_the_run(mode: gym.vector.AutoresetMode | None) -> None:
    """It is at rest in its last observation, its clock put back: the camera's is not."""
    arguments = {"context": ["psi"], "terrain_pool": 2}
    env = (
        PerceiveTerrain(gym.make(ROUGH_ID, **arguments))
        if mode is None
        else VectorPerceiveTerrain(gym.make_vec(ROUGH_ID, num_envs=2, autoreset_mode=mode, **arguments))
    )
    env.reset(seed=0)
    still = np.zeros(env.action_space.shape)
    for _ in range(5):
        env.step(still)
    base = env.unwrapped
    (base.data.qvel if mode is None else base.batch.bind("qvel")[1])[0] = 1e6
    observation, _, terminated, _, info = env.step(still)
    np.testing.assert_array_equal(terminated, True if mode is None else [False, True])
    if mode is gym.vector.AutoresetMode.SAME_STEP:
        assert np.isfinite(info["final_obs"][1]["elevation"]).all()
    if mode is None:
        env.reset()
    elif mode is gym.vector.AutoresetMode.DISABLED:
        env.reset(options={"reset_mask": np.array([True, False])})  # the other one still waits
        env.reset(options={"reset_mask": np.array([False, True])})
    for _ in range(12):
        assert np.isfinite(observation["elevation"]).all()
        observation, _, terminated, *_ = env.step(still)
        assert not np.any(terminated)
    assert env.valid.any((-2, -1)).all(), "the next episode's camera sees"


NOISE = {"proprio": {"sd": 0.1}}
SEEDS = [range(4, 7), np.arange(4, 7), list(np.arange(4, 7)), (4, 5, np.int32(6)), np.int64(4), 4]


@pytest.mark.parametrize("seed", SEEDS, ids=lambda s: type(s).__name__)
def test_seeds_of_any_kind_are_those_of_the_wrappers_too(seed: Any) -> None:
    def drawn(seed: Any) -> tuple[Any, ...]:
        envs = VectorPerturbSignals(VectorRandomizePsi(_vector(), 0.5), NOISE)
        return envs.reset(seed=seed)[0], envs.step(np.zeros((N, 2)))[0]

    same(drawn(seed), drawn([4, 5, 6]))


@pytest.mark.parametrize(
    ("seed", "message"),
    [
        (range(2), r"seed is range\(0, 2\), which holds 2 seeds, want one for each of 3"),
        ([0, 1.5, 2], r"seed\[1\] is 1\.5, want a whole number, or None"),
        (np.zeros(3), r"seed\[0\] is .*0\.0.*, want a whole number"),
        (np.zeros((3, 1)), r"seed\[0\] is array\(\[0\.\]\), want a whole number"),
        (2.5, r"seed is 2\.5, want a whole number, or one for each of 3"),
        (np.array(2.5), r"seed is array\(2\.5\), want a whole number"),
        ("012", "seed is '012', want a whole number"),
        (iter([0, 1, 2]), "seed is <list_iterator .*, want a whole number"),
    ],
)
@pytest.mark.parametrize("wrap", [lambda e: e, lambda e: VectorPerturbSignals(e, NOISE)], ids=["bare", "wrapped"])
def test_what_are_no_seeds_is_told(wrap: Any, seed: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        wrap(_vector()).reset(seed=seed)


def test_a_wrapper_that_comes_after_the_seed_draws_from_it_too() -> None:
    drawn = []
    for first in (True, False):
        envs = _vector()
        if first:
            envs.reset(seed=7)
        envs = VectorRandomizePsi(envs, 0.5)
        envs.reset(seed=None if first else 7)
        drawn.append(envs.psi)
    same(*drawn)


def test_rows_without_a_seed_go_on() -> None:
    """A list of nothing is no seed: neither the rows' generators nor the wrapper's begin anew."""
    one, two = (VectorPerturbSignals(_vector(), NOISE) for _ in range(2))
    same(one.reset(seed=0)[0], two.reset(seed=[0, 1, 2])[0])
    same(one.reset()[0], two.reset(seed=[None] * N)[0])


def test_each_row_holds_what_its_own_first_action_said() -> None:
    rng = np.random.default_rng(0)
    space = _vector().unwrapped.psi_space
    psi = space.nominal * (1 + 0.05 * rng.standard_normal((100, len(space))))
    delta = 0.01 * rng.standard_normal((100, NV))
    envs = VectorHallucinate(VectorApplyEffects(_vector(), [LOAD]), Fidelity(psi, delta))
    envs.reset(seed=0)
    model = envs.unwrapped.model
    base, mass = model.body("base").id, envs.unwrapped.batch.expand("body_mass")
    size = envs.single_action_space.shape[0]
    assert size == 2 + len(space) + NV
    mean = envs.belief.at(np.zeros(size - 2), 1.0).psi
    assert mean is not None
    np.testing.assert_allclose(mass[:, base], mean[0] + 3.0)
    actions = np.zeros((N, size), np.float32)
    actions[:, 2] = [-1, 0, 1]
    for k in range(2 * END + 2):
        envs.step(actions)
        if k % (END + 1) < END:
            wanted = envs.belief.at(np.array([[h, *np.zeros(size - 3)] for h in (-1, 0, 1)]), 1.0)
            assert wanted.psi is not None
            np.testing.assert_allclose(mass[:, base], wanted.psi[:, 0] + 3.0)
    single = Hallucinate(gym.make(ID, context=["psi"]), Fidelity(psi))
    single.reset(seed=0)
    single.step(actions[2, : 2 + len(space)])
    assert single.unwrapped.model.body_mass[base] == pytest.approx(wanted.psi[2, 0], rel=1e-2)


def test_psi_alone_holds_for_an_episode_whatever_later_actions_say() -> None:
    """With nothing beneath that acts in the physics, and bit for bit as around a single environment."""
    nominal = gym.make(ID).unwrapped.psi_space.nominal
    psi = nominal * (1 + 0.1 * np.random.default_rng(0).uniform(-1, 1, (50, len(nominal))))
    single, envs = Hallucinate(gym.make(ID, context=["psi"]), psi), VectorHallucinate(_vector(), psi)
    base, mass = single.unwrapped.model.body("base").id, envs.unwrapped.batch.expand("body_mass")
    single.reset(seed=0)
    envs.reset(seed=0)
    size = single.action_space.shape[0]
    first = None
    for h in (1, -1, 0):
        action = np.r_[0.3, 0.2, np.full(size - 2, h)].astype(np.float32)
        seen, *_ = single.step(action)
        observed, *_ = envs.step(np.tile(action, (N, 1)))
        first = mass[0, base] if first is None else first
        assert mass[0, base] == first == single.unwrapped.model.body_mass[base]
        np.testing.assert_array_equal(observed["proprio"][0], seen["proprio"])
    assert first != nominal[0]


@pytest.mark.parametrize("width", [1, 2, 20, 40])
def test_an_action_of_another_width_is_refused_at_every_step(width: int) -> None:
    psi = np.tile(gym.make(ID).unwrapped.psi_space.nominal, (3, 1)) * np.array([[0.9], [1], [1.1]])
    single, envs = Hallucinate(gym.make(ID, context=["psi"]), psi), VectorHallucinate(_vector(), psi)
    single.reset(seed=0)
    envs.reset(seed=0)
    for _ in range(2):
        with pytest.raises(InputError, match=rf"shape \({width},\), want \(19,\)"):
            single.step(np.zeros(width, np.float32))
        with pytest.raises(InputError, match=rf"shape \({N}, {width}\), want \({N}, 19\)"):
            envs.step(np.zeros((N, width), np.float32))
        single.step(np.zeros(19, np.float32))
        envs.step(np.zeros((N, 19), np.float32))


def test_a_belief_is_shown_in_every_episode_in_place_of_the_truth() -> None:
    space = gym.make(ID).unwrapped.psi_space
    belief = {"base_mass": 16.0}
    shown = np.clip(space.normalise(space.vector(belief)), -1, 1).astype(np.float32)
    envs = VectorRandomizePsi(_vector(), 0.5, belief=belief)
    observed, _ = envs.reset(seed=0)
    for _ in range(END + 2):
        np.testing.assert_allclose(observed["psi"], np.tile(shown, (N, 1)), rtol=1e-6)
        observed, *_ = envs.step(envs.action_space.sample())
    assert (envs.psi != space.vector(belief)).any(1).all()
    observed, _ = RandomizePsi(gym.make(ID), 0.5, belief=belief).reset(seed=0)
    np.testing.assert_allclose(observed["psi"], shown, rtol=1e-6)
    with pytest.raises(InputError, match="finite numbers: base_mass"):
        VectorRandomizePsi(_vector(), belief=[1.0])
    with pytest.raises(InputError, match="observes no psi"):
        RandomizePsi(gym.make("Ant-v5"), {"torso": (0.3, 0.4)}, belief=[0.3])


def test_hallucinated_ground_is_refused() -> None:
    with pytest.raises(InputError, match="VectorResidualTerrain"):
        VectorHallucinate(_vector(), Fidelity(delta_e=np.zeros((3, 256, 256))))


ALL = [
    (RandomizePsi, VectorRandomizePsi, ({},)),
    (ResidualDynamics, VectorResidualDynamics, (BIAS,)),
    (ResidualTerrain, VectorResidualTerrain, (np.zeros((256, 256)),)),
    (Hallucinate, VectorHallucinate, (Fidelity(delta_s=np.zeros((2, NV))),)),
    (ApplyEffects, VectorApplyEffects, ([],)),
    (PerceiveTerrain, VectorPerceiveTerrain, ()),
    (PerturbSignals, VectorPerturbSignals, ({},)),
    (MonitorAnomaly, VectorMonitorAnomaly, (object(), 1.0)),
    (RecordLog, VectorRecordLog, ("logs",)),
]


@pytest.mark.parametrize(("single", "vector", "arguments"), ALL)
def test_each_refuses_the_others_environments(single: Any, vector: Any, arguments: tuple[Any, ...]) -> None:
    assert vector.__name__ == f"Vector{single.__name__}"
    with pytest.raises(InputError, match=f"Vector{single.__name__}"):
        single(gym.make_vec("Ant-v5", 1), *arguments)
    with pytest.raises(InputError, match=f"use {single.__name__}"):
        vector(gym.make("Ant-v5"), *arguments)


@pytest.mark.parametrize("vector", [VectorRandomizePsi, VectorResidualDynamics, VectorApplyEffects, VectorRecordLog])
def test_vector_environments_of_others_are_refused(vector: Any, tmp_path) -> None:
    arguments = {VectorRandomizePsi: 0.5, VectorResidualDynamics: np.zeros(14), VectorApplyEffects: []}
    with pytest.raises(InputError, match=r"mujoco\.batch.*SyncVectorEnv.*wrappers="):
        vector(gym.make_vec("Ant-v5", 1), arguments.get(vector, tmp_path))


ROUGH_ID = "nfc_gym/JackalRough-v0"
SEEN = np.linspace(0.1, 0.9, 15)  # of `proprio`: velocities, and entries that are no physical state
LAST: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "camera": (lambda e: PerceiveTerrain(e), lambda e: VectorPerceiveTerrain(e)),
    "force": (lambda e: ResidualDynamics(e, SEEN), lambda e: VectorResidualDynamics(e, SEEN)),
    "state": (
        lambda e: ResidualDynamics(e, 0.01 * SEEN, mode="state"),
        lambda e: VectorResidualDynamics(e, 0.01 * SEEN, mode="state"),
    ),
    "signals": (
        lambda e: PerturbSignals(e, {"proprio": {"bias": 5.0, "delay": 2}, "action": {"delay": 1}}),
        lambda e: VectorPerturbSignals(e, {"proprio": {"bias": 5.0, "delay": 2}, "action": {"delay": 1}}),
    ),
    "ground": (
        lambda e: ResidualTerrain(e, np.full((256, 256), 0.1)),
        lambda e: VectorResidualTerrain(e, np.full((256, 256), 0.1)),
    ),
    "together": (
        lambda e: PerturbSignals(PerceiveTerrain(ResidualDynamics(e, SEEN)), {"elevation": {"bias": 1.0}}),
        lambda e: VectorPerturbSignals(
            VectorPerceiveTerrain(VectorResidualDynamics(e, SEEN)), {"elevation": {"bias": 1.0}}
        ),
    ),
}


@pytest.mark.parametrize(
    ("stack", "context"), [*((name, context) for name in LAST for context in (["psi"], ["elevation"])), ("camera", [])]
)
def test_an_episodes_last_observation_is_what_the_wrapper_makes_of_it(
    stack: str, context: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of same-step autoreset it is in `final_obs`, while the one returned is the next episode's."""
    begin = PerceivedMap.reset

    def alike(self: PerceivedMap, rng: Any, mask: Any = None) -> None:  # cameras draw the same, single or many
        begin(
            self, [np.random.default_rng(0) for _ in rng] if isinstance(rng, list) else np.random.default_rng(0), mask
        )

    monkeypatch.setattr(PerceivedMap, "reset", alike)
    mode, arguments = gym.vector.AutoresetMode.SAME_STEP, {"terrain_pool": 2, "max_episode_steps": 3}
    wrap, twin = LAST[stack]
    made = lambda: gym.make(ROUGH_ID, context=context, **arguments)  # noqa: E731
    ours = twin(gym.make_vec(ROUGH_ID, num_envs=2, context=context, autoreset_mode=mode, **arguments))
    theirs = gym.vector.SyncVectorEnv([lambda: wrap(made())] * 2, autoreset_mode=mode)
    same(ours.reset(seed=3)[0], theirs.reset(seed=3)[0])
    rng = np.random.default_rng(0)
    for k in range(8):
        actions = rng.uniform(-1, 1, (2, 2)).astype(np.float32)
        (seen, *_, info), (expected, *_, wanted) = ours.step(actions), theirs.step(actions)
        same(seen, expected)
        assert ("final_obs" in info) == (k % 3 == 2) == ("final_obs" in wanted)
        if "final_obs" in info:
            assert all(last in ours.single_observation_space for last in info["final_obs"])
            same(list(info["final_obs"]), list(wanted["final_obs"]))


@pytest.mark.parametrize(
    "bad",
    [
        {"options": {"psi": {"base_mass": -1.0}}, "seed": 5},
        {"options": {"terrain_id": 9}},
        {"options": {"reset_mask": np.ones(2, bool)}},
        {"options": 3, "seed": 5},
        {"seed": -1},
    ],
)
def test_a_reset_that_is_refused_changes_nothing(bad: dict[str, Any]) -> None:
    shown = []
    for refused in (False, True):
        env: Any = gym.make_vec(
            "nfc_gym/JackalRough-v0", num_envs=N, context=["psi"], terrain_pool=2, autoreset_mode="Disabled"
        )
        env = VectorResidualTerrain(env, np.random.default_rng(0).normal(0, 0.02, (4, 256, 256)))
        env = VectorPerturbSignals(env, {"proprio": {"bias_sd": 0.1}, "action": {"delay": 2}})
        env = VectorResidualDynamics(VectorRandomizePsi(env, 0.5), np.zeros((9, 15)) + np.arange(9)[:, None] / 100)
        env.reset(seed=0)
        out = [env.step(np.full((N, 2), k / 3))[0] for k in range(3)]
        if refused:
            with pytest.raises((InputError, gym.error.Error)):
                env.reset(**bad)
        out += [env.step(np.zeros((N, 2)))[0], env.reset(options={"reset_mask": np.arange(N) > 0})[0]]
        shown.append([*out, env.step(np.zeros((N, 2)))[0]])
    same(shown[1], shown[0])


def _grounds(samples: np.ndarray, n: int = N) -> Any:
    made = gym.make_vec(ROUGH_ID, num_envs=n, context=["psi"], terrain_pool=2, autoreset_mode="Disabled")
    return VectorResidualTerrain(made, samples)


def test_ground_that_is_refused_is_drawn_again() -> None:
    """Too high a residual: nothing was drawn, and the next reset does not begin without one."""
    envs = _grounds(np.full((256, 256), 50.0))
    for _ in range(2):
        with pytest.raises(InputError, match=r"maps\[0\] reaches"):
            envs.reset(seed=0)
        with pytest.raises(InputError, match="at the first reset"):
            envs.delta_e  # noqa: B018 (raises)
    some = _grounds(np.stack([np.zeros((256, 256)), np.full((256, 256), 50.0)]))
    some.reset(seed=next(s for s in range(99) if _level(some, s)))
    before = some.env.unwrapped.batch
    stream = some.rng.bit_generator.state
    with pytest.raises(InputError, match="reaches"):
        some.reset(seed=next(s for s in range(99) if not _level(some, s)))
    assert some.env.unwrapped.batch is before
    assert some.rng.bit_generator.state == stream
    assert not some.delta_e.any()
    some.step(np.zeros((N, 2)))


def _level(envs: Any, seed: int) -> bool:
    """Whether a reset with a seed draws level ground for every map."""
    kept, envs.rng = envs.rng, None
    level = not envs.draws.draw(2, envs.stream(seed)).any()
    envs.rng = kept
    return level


@pytest.mark.parametrize("n", [1, N])
def test_a_mask_of_all_keeps_the_ground(n: int) -> None:
    envs = _grounds(np.arange(5.0)[:, None, None] * np.ones((256, 256)) / 10, n)
    envs.reset(seed=0, options={"reset_mask": np.ones(n, bool)})
    batch, residual = envs.unwrapped.batch, envs.delta_e
    envs.step(np.zeros((n, 2)))
    envs.reset(options={"reset_mask": np.ones(n, bool)})
    assert envs.unwrapped.batch is batch
    same(envs.delta_e, residual)
    envs.reset()
    assert envs.unwrapped.batch is not batch


def test_the_first_ground_is_that_of_all() -> None:
    """The environment itself was reset before it was wrapped, and would take the mask."""
    bare = gym.make_vec(ROUGH_ID, num_envs=N, context=["psi"], terrain_pool=2, autoreset_mode="Disabled")
    bare.reset(seed=0)
    batch = bare.unwrapped.batch
    envs = VectorResidualTerrain(bare, np.full((256, 256), 0.1))
    with pytest.raises(InputError, match="first reset must be of all"):
        envs.reset(options={"reset_mask": np.arange(N) > 0})
    assert bare.unwrapped.batch is batch
    bare.step(np.zeros((N, 2)))
