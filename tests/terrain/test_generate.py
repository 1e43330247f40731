"""Generated terrains: reproducible, flat at difficulty 0 and where robots start, only ever harder with difficulty."""

import cv2
import numpy as np
import pytest

from nfc_gym.core.errors import InputError
from nfc_gym.terrain import KINDS, Heightfield, make, obstacles, pool
from nfc_gym.terrain.kinds import AMPLITUDES, SINGLE
from nfc_gym.terrain.towers import CLEARANCE


def roughness(heightfield: Heightfield) -> float:
    """Mean difference of neighbouring heights [m]."""
    return float(sum(np.abs(np.diff(heightfield.heights, axis=axis)).mean() for axis in (0, 1)))


@pytest.mark.parametrize("kind", KINDS)
def test_same_seed_same_bits_other_seed_other_terrain(kind: str) -> None:
    first, again, other = make(kind, 0.6, 7), make(kind, 0.6, 7), make(kind, 0.6, 8)
    assert first.heights.tobytes() == again.heights.tobytes()
    assert first.heights.shape == (256, 256)
    assert not np.array_equal(first.heights, other.heights)


@pytest.mark.parametrize("kind", KINDS)
def test_difficulty_only_makes_it_rougher(kind: str) -> None:
    for seed in range(3):
        measured = [roughness(make(kind, d, seed)) for d in np.linspace(0, 1, 6)]
        assert measured[0] == 0.0
        assert (np.diff(measured) > 0).all(), (seed, measured)


@pytest.mark.parametrize("kind", KINDS)
def test_robots_start_on_level_ground(kind: str) -> None:
    for spawn in (0.5, 1.5):
        heightfield = make(kind, 1.0, 3, spawn=spawn)
        angle = np.linspace(0, 2 * np.pi, 60)
        for radius in np.linspace(0, spawn - 0.15, 5):
            xy = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
            np.testing.assert_array_equal(heightfield.height(xy), 0.0)


def test_the_rim_of_the_patch_is_no_step() -> None:
    """Just outside the patch the terrain has hardly begun: a smooth rim leaves level with no slope."""
    heights = make("gaps", 1.0, 0, spawn=1.0, resolution=0.05)
    ring = np.linspace(0, 2 * np.pi, 100)
    just_out = 1.05 * np.stack([np.cos(ring), np.sin(ring)], axis=-1)
    assert np.abs(heights.height(just_out)).max() < 0.02 * AMPLITUDES["gap_depth"][0]


def test_amplitudes_are_those_of_the_table() -> None:
    far = (slice(0, 80), slice(None))  # away from the spawn patch
    assert make("rough", 0.5, 0).heights.std() == pytest.approx(0.5 * AMPLITUDES["roughness"][0], rel=0.02)
    slopes = make("slopes", 1.0, 0).heights[far]
    assert 0.9 < np.abs(np.diff(slopes, axis=0)).max() / 0.1 / AMPLITUDES["grade"][0] < 1.00001
    risers = np.abs(np.diff(make("steps", 0.5, 0).heights[far], axis=0))
    np.testing.assert_allclose(risers[risers > 1e-6], 0.5 * AMPLITUDES["riser"][0], rtol=1e-5)
    assert make("gaps", 0.5, 0).heights.min() == pytest.approx(-0.5 * AMPLITUDES["gap_depth"][0])
    assert make("stones", 0.5, 0).heights.min() == pytest.approx(-0.5 * AMPLITUDES["stone_depth"][0])


@pytest.mark.parametrize("kind", KINDS)
def test_scale_multiplies_heights(kind: str) -> None:
    np.testing.assert_allclose(make(kind, 0.8, 1, scale=0.25).heights, 0.25 * make(kind, 0.8, 1).heights, atol=1e-6)


def test_mixed_holds_every_kind_without_walls_at_the_seams() -> None:
    mixed = make("mixed", 1.0, 4).heights
    drops = np.abs(np.diff(mixed, axis=0))
    deepest = AMPLITUDES["stone_depth"][0] + 2 * AMPLITUDES["stone_lift"][0]
    assert AMPLITUDES["gap_depth"][0] < drops.max() < 1.2 * deepest
    # The tops of stones and the ground between gaps lie level with the rest: nothing towers over its surroundings.
    around = cv2.morphologyEx(mixed, cv2.MORPH_CLOSE, np.ones((9, 9)))
    assert np.ptp(around) < 2.0


@pytest.mark.parametrize("shape", [(64, 128), (33, 20), (2, 2)])
@pytest.mark.parametrize("kind", KINDS)
def test_other_shapes_and_resolutions(kind: str, shape: tuple[int, int]) -> None:
    heightfield = make(kind, 0.7, 0, shape=shape, resolution=0.05)
    assert heightfield.heights.shape == shape
    assert heightfield.extent == pytest.approx(((shape[1] - 1) * 0.05, (shape[0] - 1) * 0.05))


def test_a_pool_is_reproducible_and_a_larger_one_begins_with_the_smaller() -> None:
    small, large = pool(3, 5, 0.5, shape=(64, 64)), pool(5, 5, 0.5, shape=(64, 64))
    assert all(np.array_equal(a.heights, b.heights) for a, b in zip(small, large, strict=False))
    assert len({m.heights.tobytes() for m in large}) == 5
    other = pool(3, 6, 0.5, shape=(64, 64))
    assert not {m.heights.tobytes() for m in other} & {m.heights.tobytes() for m in large}


def test_a_pool_spreads_difficulties() -> None:
    measured = [roughness(m) for m in pool(4, 0, (0.0, 0.9), "rough")]
    assert measured[0] == 0.0
    assert (np.diff(measured) > 0).all()


@pytest.mark.parametrize("seed", range(4))
def test_every_free_place_among_obstacles_can_be_reached(seed: int) -> None:
    """At flying height the free space, shrunk by a robot's radius of a third of the clearance, is one piece."""
    heightfield = obstacles(1.0, seed)
    free = np.pad((heightfield.heights < 0.5).astype(np.uint8), 10, constant_values=1)
    across = 2 * round(CLEARANCE / 3 / heightfield.resolution) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (across, across))
    room = cv2.erode(free, disc)
    assert cv2.connectedComponents(room)[0] == 2  # the obstacles and one piece of free space
    assert (heightfield.heights > 0.5).mean() > 0.03


def test_goal_and_corridor_stay_free() -> None:
    goal = np.array([8.0, -6.0])
    blocked = 0
    for seed in range(8):
        way = np.linspace(0, 1, 200)[:, None] * goal
        side = np.array([6.0, 8.0]) / 10 * 0.65
        passage = np.concatenate([way - side, way, way + side])
        heightfield = obstacles(1.0, seed, goal=(8.0, -6.0), corridor=1.5)
        assert heightfield.height(passage).max() == 0.0
        turn = np.linspace(0, 2 * np.pi, 50)
        assert heightfield.height(goal + 0.85 * np.stack([np.cos(turn), np.sin(turn)], axis=-1)).max() == 0.0
        blocked += obstacles(1.0, seed).height(passage).max() > 0
    assert blocked > 4  # without a corridor most passages are not free, so the above says something


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("hills", 0.5, 0), "'hills'.*rough, slopes"),
        (("rough", 1.5, 0), "difficulty 1.5"),
        (("rough", float("nan"), 0), "difficulty nan"),
        (("rough", "hard", 0), "difficulty 'hard': want a number from 0"),
        (("rough", True, 0), "difficulty True: want a number from 0"),
        (("rough", 0.5, True), "seed True"),
        (("rough", 0.5, 0, 9), r"shape 9: want \(nrow, ncol\)"),
        (("rough", 0.5, 0, (9.5, 9)), r"shape \(9.5, 9\): want \(nrow, ncol\)"),
        (("rough", 0.5, 0, (9, 9), "fine"), "resolution 'fine': want a number above 0"),
        (("rough", 0.5, 0, (9, 9), 0.1, "wide"), "spawn 'wide': want a radius"),
        (("rough", 0.5, -1), "seed -1"),
        (("rough", 0.5, 0.5), "seed 0.5"),
        (("rough", 0.5, 0, (1, 9)), r"shape \(1, 9\)"),
        (("rough", 0.5, 0, (9, 9), 0.0), "resolution 0.0"),
        (("rough", 0.5, 0, (9, 9), 0.1, -1.0), "spawn -1.0"),
        (("rough", 0.5, 0, (9, 9), 0.1, 1.0, 0.0), "scale 0.0"),
    ],
)
def test_arguments_out_of_range_are_refused(arguments: tuple, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make(*arguments)


def test_other_refusals() -> None:
    with pytest.raises(InputError, match="size 0"):
        pool(0, 0, 0.5)
    with pytest.raises(InputError, match="size 'all'"):
        pool("all", 0, 0.5)  # type: ignore[arg-type]
    for wrong in ("hard", (0.1, 2.0), (0.1, 0.2, 0.3)):
        with pytest.raises(InputError, match=r"difficulty .*: want a number from 0 \(flat\) to 1, or two of them"):
            pool(2, 0, wrong)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"corridor -1.0: want a width"):
        obstacles(0.5, 0, goal=(5.0, 0.0), corridor=-1.0)
    for wrong in ("east", (1.0,), (np.nan, 0.0), 5):
        with pytest.raises(InputError, match=r"goal .*: want the world x and y"):
            obstacles(0.5, 0, goal=wrong)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="corridor"):
        obstacles(0.5, 0, corridor=1.0)


def test_every_amplitude_says_its_unit_and_reason() -> None:
    assert all(value > 0 and unit and reason for value, unit, reason in AMPLITUDES.values())
    assert set(SINGLE) < set(KINDS)
