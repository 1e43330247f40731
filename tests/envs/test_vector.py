"""The vector engine: equal to single environments to the bit, whatever is randomised, reset or broken."""

import gc
import multiprocessing
import os
import pickle
from copy import deepcopy
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from nfc_gym import InputError, terrain

IDS = sorted(i for i in gymnasium.registry if i.startswith("nfc_gym/"))
SMALL: dict[str, Any] = {"terrain_pool": 3}
N = 3


def same(a: Any, b: Any, where: str = "") -> None:
    """Equal to the bit, with the same keys, shapes and types."""
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for k in a:
            same(a[k], b[k], f"{where}/{k}")
    elif isinstance(a, tuple) or (isinstance(a, np.ndarray) and a.dtype == object):
        for x, y in zip(a, b, strict=True):
            assert (x is None) == (y is None), where
            if x is not None:
                same(x, y, where)
    else:
        a, b = np.asarray(a), np.asarray(b)
        assert (a.shape, a.dtype) == (b.shape, b.dtype), where
        assert np.array_equal(a, b), where


def vector(name: str, n: int = N, **kwargs: Any) -> Any:
    return gymnasium.make_vec(name, num_envs=n, **(SMALL | kwargs))


def serial(name: str, mode: AutoresetMode, n: int = N, **kwargs: Any) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: gymnasium.make(name, **(SMALL | kwargs))] * n, autoreset_mode=mode)


@pytest.mark.parametrize("mode", list(AutoresetMode))
@pytest.mark.parametrize("name", IDS)
def test_equals_single_environments(name: str, mode: AutoresetMode) -> None:
    """Observations, rewards, ends, infos, final observations: over truncations, and terminations where they happen."""
    kwargs = {"max_episode_steps": 17}
    ours, theirs = vector(name, autoreset_mode=mode, **kwargs), serial(name, mode, **kwargs)
    assert ours.metadata["autoreset_mode"] is ours.unwrapped.autoreset_mode is mode
    same(ours.reset(seed=3), theirs.reset(seed=3))
    rng, ended = np.random.default_rng(0), 0
    for step in range(40):
        action = rng.uniform(-1, 1, ours.action_space.shape)
        a, b = ours.step(action), theirs.step(action)
        for part, (x, y) in enumerate(zip(a, b, strict=True)):
            same(x, y, f"step {step} part {part}")
        done = a[2] | a[3]
        ended += done.sum()
        if mode is AutoresetMode.DISABLED and done.any():
            mine = ours.reset(options={"reset_mask": done})[0]
            same(mine, theirs.reset(options={"reset_mask": done.copy()})[0])
    assert ended >= 2 * N


@pytest.mark.parametrize("name", ["nfc_gym/JackalRough-v0", "nfc_gym/AntRough-v0", "nfc_gym/QuadcopterFlat-v0"])
def test_psi_and_terrain_of_each_simulation_equal_those_of_single_environments(name: str) -> None:
    ours = vector(name)
    space = ours.unwrapped.psi_space
    psi = space.sample(np.random.default_rng(1), N)
    options = {"psi": psi, "psi_belief": psi[::-1]} | ({"terrain_id": np.array([2, 0, 1])} if "Rough" in name else {})
    obs = ours.reset(seed=4, options=options)[0]
    np.testing.assert_array_equal(ours.unwrapped.psi, psi)
    singles = [gymnasium.make(name, **SMALL) for _ in range(N)]
    for i, env in enumerate(singles):
        own = env.reset(seed=4 + i, options={k: v[i] for k, v in options.items()})[0]
        same({k: v[i] for k, v in obs.items()}, own)
        if "Rough" in name:
            chosen = ours.unwrapped.maps[ours.unwrapped.terrain_id[i]]
            same(chosen.heights, env.unwrapped.heightfield.heights)
    rng = np.random.default_rng(2)
    for _ in range(25):
        actions = rng.uniform(-0.1, 0.1, ours.action_space.shape)  # gentle enough that no episode ends
        obs, reward, ended, *_ = ours.step(actions)
        assert not ended.any()
        for i, env in enumerate(singles):
            own = env.step(actions[i])
            same({k: v[i] for k, v in obs.items()}, own[0])
            assert reward[i] == own[1]


def test_psi_by_name_for_all_or_each() -> None:
    envs = vector("nfc_gym/JackalFlat-v0")
    space = envs.unwrapped.psi_space
    envs.reset(options={"psi": {"base_mass": np.array([13.0, 15.0, 20.0]), "front_left_wheel_friction": 0.5}})
    psi = envs.unwrapped.psi
    np.testing.assert_array_equal(psi[:, 0], [13, 15, 20])
    assert (psi[:, space.names.index("front_left_wheel_friction")] == 0.5).all()
    model = envs.unwrapped.batch.get_model(2)
    assert model.body("base").mass == 20
    assert model.body("base").subtreemass == pytest.approx(20 + 4 * 0.48), "derived constants follow"
    envs.reset(seed=0, options={"psi": {"base_mass": 18.0}, "reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(envs.unwrapped.psi[:, 0], [13, 18, 20])
    envs.reset()
    np.testing.assert_array_equal(envs.unwrapped.psi, np.tile(space.nominal, (N, 1)))
    with pytest.raises(InputError, match="no parameter 'mass'"):
        envs.reset(options={"psi": {"mass": 1.0}})
    with pytest.raises(InputError, match=r"shape \(2, 17\), want \(3, 17\)"):
        envs.reset(options={"psi": np.ones((2, 17))})


@pytest.mark.parametrize("name", ["nfc_gym/JackalRough-v0", "nfc_gym/QuadrupedFlat-v0"])
def test_a_partial_reset_leaves_the_others_alone(name: str) -> None:
    """Twins, one of which has an environment reset every few steps: the others' rows stay equal to the bit."""
    ours, twin = (vector(name, autoreset_mode="Disabled") for _ in range(2))
    ours.reset(seed=0)
    twin.reset(seed=0)
    rng = np.random.default_rng(0)
    others = np.array([True, False, True])
    for step in range(12):
        if step % 3 == 2:
            ours.reset(options={"reset_mask": ~others, "psi": {ours.unwrapped.psi_space.names[0]: 14.0}})
        actions = rng.uniform(-0.3, 0.3, ours.action_space.shape)
        a, b = ours.step(actions), twin.step(actions)
        for key in a[0]:
            same(a[0][key][others], b[0][key][others], key)
        same(a[1][others], b[1][others])


def test_what_is_returned_is_never_written_to_again() -> None:
    envs = vector("nfc_gym/JackalRough-v0", max_episode_steps=5, autoreset_mode="SameStep", elevation_hz=10)
    kept = [envs.reset(seed=0)]
    rng = np.random.default_rng(0)
    copies = []
    for _ in range(12):
        copies.append({k: v.copy() for k, v in {**kept[-1][0], **kept[-1][-1]}.items() if isinstance(v, np.ndarray)})
        kept.append(envs.step(rng.uniform(-1, 1, envs.action_space.shape)))
    for result, copy in zip(kept, copies, strict=False):
        for key, value in copy.items():
            held = result[0].get(key, result[-1].get(key))
            if value.dtype != object:
                np.testing.assert_array_equal(held, value, err_msg=key)
    arrays = [v for result in kept for v in result[0].values()]
    assert not any(np.shares_memory(a, b) for i, a in enumerate(arrays) for b in arrays[:i] if a.shape == b.shape)


def test_an_unstable_simulation_ends_alone() -> None:
    envs, twin = (vector("nfc_gym/AntFlat-v0", autoreset_mode="NextStep") for _ in range(2))
    envs.reset(seed=0)
    twin.reset(seed=0)
    envs.unwrapped.batch.qvel[1, 0] = np.nan
    actions = np.zeros(envs.action_space.shape)
    a, b = envs.step(actions), twin.step(actions)
    np.testing.assert_array_equal(a[-1]["unstable"], [False, True, False])
    np.testing.assert_array_equal(a[2], [False, True, False])
    assert a[1][1] == 0
    assert all(np.isfinite(v).all() for v in a[0].values())
    for row in (0, 2):
        same(a[0]["proprio"][row], b[0]["proprio"][row])
    assert not envs.step(actions)[-1]["unstable"].any()


def test_reset_hooks_serve_every_reset() -> None:
    """A hook randomises psi at each reset, autoresets too; what `reset` itself is told wins."""
    envs = vector("nfc_gym/JackalFlat-v0", max_episode_steps=4, autoreset_mode="NextStep")
    calls = []

    def hook(ids: np.ndarray) -> dict[str, Any]:
        calls.append(ids.tolist())
        return {"psi": {"base_mass": 14.0 + ids}}

    envs.unwrapped.reset_hooks.append(hook)
    envs.reset(seed=0)
    np.testing.assert_array_equal(envs.unwrapped.psi[:, 0], [14, 15, 16])
    envs.reset(seed=0, options={"psi": {"base_mass": 20.0}})
    assert (envs.unwrapped.psi[:, 0] == 20).all()
    for _ in range(5):
        envs.step(np.zeros((N, 2)))
    np.testing.assert_array_equal(envs.unwrapped.psi[:, 0], [14, 15, 16])
    assert calls == [[0, 1, 2]] * 3


def test_substep_hooks_see_every_physics_step() -> None:
    envs, twin = (vector("nfc_gym/JackalFlat-v0") for _ in range(2))
    times: list[float] = []
    envs.unwrapped.substep_hooks.append(lambda env: times.append(float(env.batch.time[0])))
    same(envs.reset(seed=0), twin.reset(seed=0))
    actions = np.full((N, 2), 0.5)
    for _ in range(3):
        same(envs.step(actions)[0], twin.step(actions)[0])
    np.testing.assert_allclose(times, 0.005 * np.arange(12), atol=1e-9)
    envs.unwrapped.substep_hooks.clear()
    envs.unwrapped.after_hooks.append(lambda env: times.append(float(env.batch.time[0])))
    envs.step(actions)
    assert times[12:] == pytest.approx([0.08])
    envs.unwrapped.control_hooks.append(lambda env: times.append(float(env.batch.time[0])))
    envs.step(actions)
    assert times[13:] == pytest.approx([0.08, 0.1])


def test_terrains_are_replaced() -> None:
    """Heights simulated and perceived change; the environments' generators go on where they stood."""
    envs, twin = vector("nfc_gym/JackalRough-v0"), vector("nfc_gym/JackalRough-v0")
    envs.reset(seed=0)
    twin.reset(seed=0)
    maps = [terrain.Heightfield(np.full((256, 256), h, np.float32)) for h in (0.0, 0.5, 2.0)]
    seen = [np.full((256, 256), -1.0)] * 3
    envs.unwrapped.set_terrains(maps, seen)
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(np.zeros((N, 2)))
    obs, _ = envs.reset(seed=0, options={"terrain_id": np.arange(3)})
    home = envs.unwrapped.robot.home[2]
    np.testing.assert_allclose(envs.unwrapped.batch.qpos[:, 2], home + np.array([0, 0.5, 2.0]), atol=1e-5)
    np.testing.assert_allclose(obs["elevation"][:, 0, 0], -1 - home - np.array([0, 0.5, 2.0]), atol=1e-5)
    for _ in range(25):
        obs, *_ = envs.step(np.zeros((N, 2)))
    np.testing.assert_allclose(obs["proprio"][:, 12], home + np.array([0, 0.5, 2.0]), atol=5e-3)
    with pytest.raises(InputError, match=r"maps\[1\] has shape"):
        envs.unwrapped.set_terrains([maps[0], np.zeros((3, 3))])
    for wrong in (None, 5, "maps"):
        with pytest.raises(InputError, match=f"maps is {wrong!r}, want a sequence of maps"):
            envs.unwrapped.set_terrains(wrong)
    with pytest.raises(InputError, match="0 to 2"):
        envs.reset(options={"terrain_id": 3})
    with pytest.raises(InputError, match="set_terrains"):
        envs.reset(options={"heightfield": maps[0].heights})
    assert envs.unwrapped.heightfield[1] is maps[1]
    envs.unwrapped.set_terrains(twin.unwrapped.maps)
    envs.reset(seed=4)
    envs.unwrapped.set_terrains(twin.unwrapped.maps)
    twin.reset(seed=4)
    same(envs.reset()[0], twin.reset()[0])
    with pytest.raises(InputError, match="use the Rough one"):
        vector("nfc_gym/JackalFlat-v0").unwrapped.set_terrains(maps)


def test_bad_input() -> None:
    envs = vector("nfc_gym/JackalFlat-v0", autoreset_mode="Disabled", max_episode_steps=1)
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(np.zeros((N, 2)))
    with pytest.raises(InputError, match="first reset must be of all"):
        envs.reset(options={"reset_mask": np.array([True, False, False])})
    envs.reset(seed=[1, 2, None])
    with pytest.raises(InputError, match="3 environments"):
        envs.reset(seed=[1, 2])
    with pytest.raises(InputError, match="at least one True"):
        envs.reset(options={"reset_mask": np.zeros(N, bool)})
    actions = np.zeros((N, 2))
    actions[2, 1] = np.inf
    with pytest.raises(InputError, match=r"action\[2, 1\] is inf"):
        envs.step(actions)
    with pytest.raises(InputError, match=r"shape \(2, 2\), want \(3, 2\)"):
        envs.step(actions[:2])
    assert envs.step(np.full((N, 2), 1e308))[3].all(), "finite values of any size are clipped"
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"\[0, 1, 2\]"):
        envs.step(np.zeros((N, 2)))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"n": 0}, "num_envs is 0, want a whole number, 1 or more"),
        ({"n": 2.5}, "num_envs is 2.5"),
        ({"nthread": -4}, "nthread is -4, want a whole number, 0 or more"),
    ],
)
def test_bad_sizes_are_told(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        vector("nfc_gym/JackalFlat-v0", **arguments)


@pytest.mark.parametrize("bad", ["x", True, [True] * N, np.nan, [1], [[1], [1, 2]]])
def test_what_names_no_terrain_is_told(bad: Any) -> None:
    with pytest.raises(InputError, match=r"^terrain_id"):
        vector("nfc_gym/JackalRough-v0").reset(options={"terrain_id": bad})


def test_it_is_made_anew_in_place_of_a_copy() -> None:
    envs = vector("nfc_gym/JackalFlat-v0")
    for copied in (pickle.dumps, deepcopy):
        with pytest.raises(TypeError, match=r"make it anew with gymnasium\.make_vec"):
            copied(envs)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_worker_may_forget_the_environments_of_its_parent() -> None:
    """Their threads are not in the worker, which would wait for them forever."""
    held = [vector("nfc_gym/JackalFlat-v0", nthread=2)]
    held[0].reset(seed=0)

    def forget() -> None:
        held.clear()
        gc.collect()

    worker = multiprocessing.get_context("fork").Process(target=forget)
    worker.start()
    worker.join(20)
    code = worker.exitcode
    worker.kill()
    assert code == 0
    same(held[0].step(np.zeros((N, 2)))[2], np.zeros(N, bool))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.parametrize(("threads", "word"), [(2, "its threads stayed behind"), (1, "stepped")])
def test_a_forked_worker_is_told_that_it_cannot_step_what_its_parent_made(threads: int, word: str) -> None:
    envs = vector("nfc_gym/JackalFlat-v0", nthread=threads)
    envs.reset(seed=0)
    context = multiprocessing.get_context("fork")
    said = context.Queue()

    def step() -> None:
        try:
            envs.step(np.zeros((N, 2)))
            said.put("stepped")
        except InputError as e:
            said.put(str(e))

    worker = context.Process(target=step)
    worker.start()
    found = said.get(timeout=60)
    worker.join(20)
    worker.kill()
    assert word in found
    same(envs.step(np.zeros((N, 2)))[2], np.zeros(N, bool))


def test_the_length_of_episodes_is_a_whole_number() -> None:
    for wrong in (0, 2.5, "a"):
        with pytest.raises(InputError, match=r"max_episode_steps is .*, want a whole number, 1 or more"):
            vector("nfc_gym/JackalFlat-v0", max_episode_steps=wrong)
    endless = vector("nfc_gym/JackalFlat-v0", max_episode_steps=-1)
    endless.reset(seed=0)
    assert not endless.step(np.zeros((N, 2)))[3].any()
    with pytest.raises(InputError, match=r"seed is 1\.5, want a whole number"):
        endless.reset(seed=1.5)
    # None is what the id was registered with, whatever the kind of vector environment.
    assert (
        vector("nfc_gym/JackalFlat-v0", max_episode_steps=None)._horizon
        == gymnasium.spec("nfc_gym/JackalFlat-v0").max_episode_steps
    )


def test_maps_of_all_may_be_named_where_some_are_reset() -> None:
    envs = vector("nfc_gym/JackalRough-v0", context=["psi"])
    envs.reset(seed=0, options={"terrain_id": 0})
    envs.reset(options={"reset_mask": np.array([True, False, True]), "terrain_id": np.array([1, 1, 2])})
    assert envs.unwrapped.terrain_id.tolist() == [1, 0, 2]


def test_threads_change_no_bit() -> None:
    one, two = (vector("nfc_gym/AntFlat-v0", n=8, nthread=k, context=["psi"]) for k in (1, 2))
    same(one.reset(seed=0), two.reset(seed=0))
    rng = np.random.default_rng(0)
    for _ in range(50):
        actions = rng.uniform(-1, 1, one.action_space.shape)
        same(one.step(actions), two.step(actions))


def test_seeds_are_kept_as_gymnasiums_own_vectors_keep_them() -> None:
    """A wrapper that is put on later draws from them."""
    ours = vector("nfc_gym/JackalFlat-v0", context=["psi"])
    theirs = gymnasium.make_vec("nfc_gym/JackalFlat-v0", num_envs=N, vectorization_mode="sync", context=["psi"])
    assert len(set(ours.np_random_seed)) == N
    for seed in (7, None, [None, 4, None]):
        for envs in (ours, theirs):
            envs.reset(seed=seed)
        assert ours.np_random_seed == theirs.np_random_seed
        same(*([g.bit_generator.state["state"]["state"] for g in e.np_random] for e in (ours, theirs)))
    rough = vector("nfc_gym/JackalRough-v0", context=["psi"])
    rough.reset(seed=3)
    rough.unwrapped.set_terrains(rough.unwrapped.maps)
    assert rough.np_random_seed == (3, 4, 5)
