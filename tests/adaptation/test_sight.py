"""What policies see is the same in training, where cells are looked up, and of an environment's own observation."""

from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest

from nfc_gym import InputError
from nfc_gym.adaptation.sight import CELLS, Sight, VectorSight
from nfc_gym.adaptation.worlds import VectorStaggered, vector_env
from nfc_gym.simulate.machine import full_id
from nfc_gym.terrain.egocentric import SIZE, Cells


@pytest.mark.parametrize("name", ["JackalRough", "AntRough", "QuadcopterRough"])
def test_cells_that_are_looked_up_are_those_of_the_whole_map(name: str) -> None:
    seen = VectorSight(vector_env(name, 3, threads=1, terrain_pool=2))
    whole = gym.make_vec(full_id(name), num_envs=3, autoreset_mode="Disabled", nthread=1, terrain_pool=2)
    mine, _ = seen.reset(seed=4)
    theirs, _ = whole.reset(seed=4)
    for _ in range(3):
        action = np.full(whole.action_space.shape, 0.3, np.float32)
        mine, *_ = seen.step(action)
        theirs, *_ = whole.step(action)
    flat = seen.sight.flat(theirs)
    assert flat.shape == (3, seen.sight.size)
    # Positions in the grid are rounded differently, by some 1e-6 of a cell; at a tower's edge a cell is 40 m/m steep.
    np.testing.assert_allclose(mine["observation"], flat, atol=2e-4)
    np.testing.assert_array_equal(mine["psi"], theirs["psi"])


def test_a_flat_environments_sight_is_what_it_gives_without_context() -> None:
    for name in ("JackalFlat", "QuadrupedFlat"):
        plain, dicts = gym.make(full_id(name), context=[]), gym.make(full_id(name))
        sight = Sight.of(dicts)
        np.testing.assert_array_equal(sight.flat(dicts.reset(seed=1)[0]), plain.reset(seed=1)[0])
        assert Sight.from_dict(sight.to_dict()) == sight


def test_cells_lie_evenly_around_the_robots_middle() -> None:
    for cells in CELLS.values():
        left = cells.first[1] + cells.step * np.arange(cells.shape[1])
        assert left.mean() == (SIZE - 1) / 2
    numbers = np.arange(SIZE * SIZE).reshape(SIZE, SIZE)
    np.testing.assert_array_equal(Cells((1, 2), 3, (2, 2)).of(numbers), [[130, 133], [514, 517]])


def test_what_is_not_seen_is_named() -> None:
    sight = Sight.of(gym.make("nfc_gym/JackalRough-v0", terrain_pool=1))
    with pytest.raises(InputError, match=r"'proprio' has shape \(52,\)"):
        sight.flat({"proprio": np.zeros(52)})
    with pytest.raises(InputError, match="'elevation'"):
        sight.flat({"proprio": np.zeros(15), "goal": np.zeros(2)})
    with pytest.raises(InputError, match="reaches outside"):
        Cells((100, 0), 5, (10, 1))
    with pytest.raises(InputError, match="Disabled"):
        VectorSight(gym.make_vec("nfc_gym/JackalFlat-v0", num_envs=1, context=["psi"]))
    with pytest.raises(InputError, match="no environment 'Jakal'"):
        full_id("Jakal")


@pytest.mark.parametrize("n", [1, 16])
def test_first_episodes_end_one_by_one_and_later_ones_do_not(n: int) -> None:
    """Also of one simulation alone, whose every end is one of all."""
    envs = VectorStaggered(vector_env("JackalFlat", n, threads=1, episode=40), 40, seed=0)
    envs.reset(seed=0)
    action, ends = np.zeros(envs.action_space.shape, np.float32), [[] for _ in range(n)]
    for t in range(1, 122):
        *_, truncated, _ = envs.step(action)
        for i in np.flatnonzero(truncated):
            ends[i].append(t)
        if truncated.any():
            envs.reset(options={"reset_mask": truncated})
    assert len({e[0] for e in ends}) > n // 2
    assert all(len(e) > 2 for e in ends)
    assert all(later - earlier == 40 for e in ends for earlier, later in pairwise(e))
