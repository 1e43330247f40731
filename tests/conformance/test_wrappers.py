"""What every wrapper keeps of what its environment promises, and that it changes nothing where it has nothing to do."""

import json
import pickle
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from cases import (
    BASE,
    CASES,
    MADE,
    ONE_MAP,
    SINGLE,
    VECTOR,
    actions,
    grown,
    kind,
    numbers,
    play,
    play_many,
    same,
    without,
    wrapped,
)
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

N, END, RESETS = 2, 6, 100
# Around every other: a stack of all nine, in an order that is allowed.
STACK = [
    "ResidualTerrain",
    "RandomizePsi",
    "ApplyEffects",
    "ResidualDynamics",
    "RecordLog",
    "PerceiveTerrain",
    "PerturbSignals",
    "MonitorAnomaly",
    "Hallucinate",
]


def base(**kwargs: Any) -> gym.Env:
    return gym.make(BASE, max_episode_steps=END, **(ONE_MAP | kwargs))


def bases(**kwargs: Any) -> Any:
    return gym.make_vec(BASE, num_envs=N, max_episode_steps=END, nthread=1, **(ONE_MAP | kwargs))


def stacked(env: Any, sources: Path, null: bool = False, without: str = "") -> Any:
    twin = "Vector" if isinstance(env, gym.vector.VectorEnv) else ""
    for name in [n for n in STACK if n != without]:
        env = wrapped(twin + name, env, sources, null)
    return env


def test_every_public_wrapper_has_a_case_and_a_twin() -> None:
    assert set(SINGLE) == set(CASES) == set(STACK)
    assert set(VECTOR) == {f"Vector{name}" for name in CASES}


# ---- one environment ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SINGLE)
def test_null_is_no_wrapper_bit_for_bit(name: str, sources: Path) -> None:
    made = MADE.get(name, set())
    expected = without(play(base(), 3, 15), made)
    same(without(play(wrapped(name, base(), sources, null=True), 3, 15), made), expected)


def test_all_nine_at_null_are_no_wrapper_bit_for_bit(sources: Path) -> None:
    made = set().union(*MADE.values())
    expected = without(play(base(), 3, 15), made)
    same(without(play(stacked(base(), sources, null=True), 3, 15), made), expected)


@pytest.mark.parametrize("name", SINGLE)
def test_spaces_infos_and_seeds(name: str, sources: Path) -> None:
    env = wrapped(name, base(), sources)
    rolled = play(env, 5, 15)
    keys = list(rolled[0][1])
    for observation, *rest, info in rolled:
        assert observation in env.observation_space
        assert list(info) == keys
        assert all(isinstance(v, np.ndarray | np.generic) and v.shape == () for v in info.values())
        assert not rest or (isinstance(rest[0], float) and isinstance(rest[1], bool) and isinstance(rest[2], bool))
    play(env, 6, 9)
    same(play(env, 5, 15), rolled)
    same(play(wrapped(name, base(), sources), 5, 15), rolled)
    inert = name in ("MonitorAnomaly", "RecordLog")
    if not inert:
        with pytest.raises(AssertionError):
            same(play(base(), 5, 15), rolled)


@pytest.mark.parametrize("name", [*SINGLE, "all nine"])
def test_spec_through_json(name: str, sources: Path) -> None:
    env = stacked(base(), sources) if name == "all nine" else wrapped(name, base(), sources)
    twin = gym.make(EnvSpec.from_json(json.dumps(json.loads(env.spec.to_json()))))
    assert twin.spec == env.spec
    same(play(twin, 1, 8), play(env, 1, 8))


@pytest.mark.parametrize("name", SINGLE)
def test_a_pickle_keeps_the_spec_and_begins_with_a_reset(name: str, sources: Path) -> None:
    env = wrapped(name, base(), sources)
    expected = play(env, 4, 3)
    twin = pickle.loads(pickle.dumps(env))
    assert twin.spec == env.spec
    with pytest.raises(gym.error.ResetNeeded):
        twin.step(twin.action_space.sample())
    same(play(twin, 4, 3), expected)


@pytest.mark.parametrize("name", SINGLE)
def test_actions_of_any_size_and_bad_ones(name: str, sources: Path) -> None:
    env = wrapped(name, base(), sources)
    env.reset(seed=0)
    signs = np.where(np.arange(env.action_space.shape[0]) % 2, 1.0, -1.0)
    for k in range(END - 1):
        result = env.step(1e308 * signs * (-1) ** k)
        assert all(np.isfinite(v).all() for v in numbers(result))
        assert not result[-1]["unstable"]
    for bad in (np.nan, np.inf):
        for entry in (1, len(signs) - 1):
            action = np.zeros(len(signs))
            action[entry] = bad
            with pytest.raises(ValueError, match=rf"action\[{entry}\] is {bad}"):
                env.step(action)


def for_memory(env: Any, sources: Path, which: str) -> Any:
    """RecordLog alone, since it writes each new ground down, or all eight others, of which none may keep anything."""
    twin = "Vector" if isinstance(env, gym.vector.VectorEnv) else ""
    return wrapped(twin + which, env, sources) if which == "RecordLog" else stacked(env, sources, without="RecordLog")


@pytest.mark.parametrize("which", ["RecordLog", "the other eight"])
def test_memory_is_flat_over_resets(which: str, sources: Path) -> None:
    env = for_memory(base(context=["psi"]), sources, which)
    env.reset(seed=0)
    zero = np.zeros(env.action_space.shape, np.float32)

    def episode() -> None:
        env.reset()
        env.step(zero)

    assert grown(episode, RESETS) < RESETS / 4 * mujoco.mj_sizeModel(env.unwrapped.model)


def test_memory_is_flat_over_resets_of_environments_of_others() -> None:
    pytest.importorskip("imageio", reason="Gymnasium's own MuJoCo environments need gymnasium[mujoco]")
    env: Any = SINGLE["RandomizePsi"](gym.make("Ant-v5"), space=["torso"])
    delay = {"family": "delay", "where": "hip_1", "parameters": {"delay": 0.03}}
    env = SINGLE["ApplyEffects"](env, [delay])
    env = SINGLE["ResidualDynamics"](env, 0.01 * np.ones((5, 14)), covariance=np.full(14, 1e-4))
    env = SINGLE["PerturbSignals"](env, {"observation": {"sd": 0.01, "delay": 2}})

    def episode() -> None:
        env.reset()
        env.step(np.zeros(8))

    assert grown(episode, RESETS) < RESETS / 4 * mujoco.mj_sizeModel(env.unwrapped.model)


@pytest.mark.parametrize("name", SINGLE)
def test_checks_of_gymnasium_and_stable_baselines(name: str, sources: Path) -> None:
    env = wrapped(name, base(), sources)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about the bounds and the shape of the map, as of the bare environment
        check_env(env, skip_render_check=True)
        checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="needs nfc_gym[sb3]")
        checker.check_env(env)


# ---- many -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", list(AutoresetMode))
@pytest.mark.parametrize("name", [*VECTOR, "all nine"])
def test_null_twin_is_no_wrapper_bit_for_bit(name: str, mode: AutoresetMode, sources: Path) -> None:
    made = set().union(*MADE.values()) if name == "all nine" else MADE.get(kind(name), set())
    expected = without(play_many(bases(autoreset_mode=mode), 3, 15), made)
    envs = bases(autoreset_mode=mode)
    envs = stacked(envs, sources, null=True) if name == "all nine" else wrapped(name, envs, sources, null=True)
    assert AutoresetMode(envs.metadata["autoreset_mode"]) is mode
    same(without(play_many(envs, 3, 15), made), expected)


@pytest.mark.parametrize("name", VECTOR)
def test_twins_spaces_infos_and_seeds(name: str, sources: Path) -> None:
    envs = wrapped(name, bases(), sources)
    rolled = play_many(envs, 5, 15)
    keys = list(rolled[0][1])
    for observation, *_, info in rolled:
        assert observation in envs.observation_space
        assert list(info) == keys
        assert all(isinstance(v, np.ndarray) and v.shape == (N,) for v in info.values())
    play_many(envs, 6, 9)
    same(play_many(envs, 5, 15), rolled)
    same(play_many(wrapped(name, bases(), sources), 5, 15), rolled)


@pytest.mark.parametrize("name", VECTOR)
def test_twins_actions_of_any_size_and_bad_ones(name: str, sources: Path) -> None:
    envs = wrapped(name, bases(), sources)
    envs.reset(seed=0)
    large = np.where(actions(envs, 0, END - 1) > 0, 1e308, -1e308)
    for action in large:
        result = envs.step(action)
        assert all(np.isfinite(v).all() for v in numbers(result))
        assert not result[-1]["unstable"].any()
    for entry in (0, envs.action_space.shape[1] - 1):
        action = np.zeros(envs.action_space.shape)
        action[1, entry] = np.inf
        with pytest.raises(ValueError, match=rf"action\[1, {entry}\] is inf"):
            envs.step(action)


@pytest.mark.parametrize("which", ["RecordLog", "the other eight"])
def test_memory_of_twins_is_flat_over_resets(which: str, sources: Path) -> None:
    envs = for_memory(bases(context=["psi"]), sources, which)
    envs.reset(seed=0)
    zero = np.zeros(envs.action_space.shape, np.float32)

    def episode() -> None:
        envs.reset()
        envs.step(zero)

    assert grown(episode, RESETS // 5) < RESETS / 5 / 4 * mujoco.mj_sizeModel(envs.unwrapped.model)
