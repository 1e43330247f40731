"""What the depth camera sees, against geometry worked out by hand, and what becomes of it in the fused map."""

from dataclasses import replace

import numpy as np
import pytest

from nfc_gym.core.errors import InputError
from nfc_gym.terrain import DepthCamera, Heightfield, PerceivedMap, elevation, make
from nfc_gym.terrain.scan import scan

Array = np.ndarray

QUIET = DepthCamera(subpixel=0, dropout=0, blotches=0, flying=0, drift=0, yaw_drift=0, tilt=0)
LEVEL = (1.0, 0.0, 0.0, 0.0)
FLAT = Heightfield(np.zeros((256, 256)))
FORWARD, LEFT = ((np.indices((128, 128)) - 63.5) * 0.1).astype(float)  # of the map's cells, from the base


def standing(camera: DepthCamera, heightfield: Heightfield, height: float, images: int = 11) -> PerceivedMap:
    """A robot that stands still at the origin and looks for a while."""
    perceived = PerceivedMap(camera)
    perceived.reset(np.random.default_rng(0))
    for k in range(images):
        perceived.update(heightfield, (0, 0, height), LEVEL, 0.0, 0.1 * k)
    return perceived


def last_map(perceived: PerceivedMap, heightfield: Heightfield, height: float) -> Array:
    """The map of `standing` again: nothing is due at the same time."""
    return perceived.update(heightfield, (0, 0, height), LEVEL, 0.0, 1.0)


def cloud(camera: DepthCamera, heightfield: Heightfield, eye: tuple[float, float, float], seed: int = 0) -> Array:
    """Points in the world of one image taken along x, pitched as the camera is mounted."""
    return scan(camera, heightfield, np.array(eye), camera.mount, np.random.default_rng(seed)).points + np.array(eye)


def test_depth_noise_is_that_of_the_triangulation() -> None:
    """848 columns over 87 degrees: f = 424 / tan(43.5 deg) = 446.8; at 2 m 4 x 0.08 / (446.8 x 0.05) = 14.3 mm."""
    camera = replace(QUIET, subpixel=0.08)
    assert camera.noise(np.array(2.0)) == pytest.approx(0.01432, rel=1e-3)
    eye = np.array([0, 0, 1.0])
    normalised, depths = [], []
    for seed in range(20):
        points = scan(camera, FLAT, eye, camera.mount, np.random.default_rng(seed)).points
        # On level ground the true point lies on the same ray where it reaches 1 m below the eye.
        true_depth = (points @ camera.mount[:, 0]) / -points[:, 2]
        depth = points @ camera.mount[:, 0]
        normalised.append((depth - true_depth) / camera.noise(true_depth))
        depths.append(true_depth)
    error, depth = np.concatenate(normalised), np.concatenate(depths)
    for low, high in ((1.0, 1.5), (2.5, 3.5), (4.5, 5.9)):
        here = (depth > low) & (depth < high)
        assert here.sum() > 1000
        assert abs(error[here].mean()) < 0.05
        assert error[here].std() == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize("pitch", [0.4, 0.9, np.pi / 2])
def test_the_view_on_level_ground_is_the_images_outline(pitch: float) -> None:
    camera = replace(QUIET, position=(0.2, 0.0, 0.1), pitch=pitch)
    perceived = standing(camera, FLAT, 1.0, images=10)
    offset = np.stack([FORWARD - 0.2, LEFT, np.full_like(LEFT, -1.1)], axis=-1)
    depth, left, up = np.moveaxis(offset @ camera.mount, -1, 0)
    wide, high = np.tan(np.deg2rad(43.5)), np.tan(np.deg2rad(29.0))

    def outline(margin: float) -> Array:
        sides = (np.abs(left) < wide * depth + margin) & (np.abs(up) < high * depth + margin)
        return sides & (depth > camera.near - margin) & (depth < camera.far + margin)

    valid = perceived.valid
    assert not (valid & ~outline(0.15)).any()
    assert valid[outline(-0.15)].mean() > 0.99
    assert outline(-0.15).sum() > 100


def test_a_quiet_camera_sees_the_true_map() -> None:
    ramp = Heightfield(np.broadcast_to(0.2 * (np.arange(256) * 0.1 - 12.75), (256, 256)))
    for heightfield in (FLAT, ramp, make("rough", 0.5, 1)):
        height = float(heightfield.height([0, 0])) + 0.6
        perceived = standing(QUIET, heightfield, height)
        difference = last_map(perceived, heightfield, height) - elevation(heightfield, (0, 0, height), 0.0)
        # At the rim a cell's points lie up to half a cell off its middle, and the map reaches half a cell beyond that.
        steepest = sum(np.abs(np.diff(heightfield.heights, axis=axis)).max() for axis in (0, 1))
        assert perceived.valid.sum() > 500
        assert np.abs(difference[perceived.valid]).max() < steepest + 1e-5
        assert abs(np.median(difference[perceived.valid])) < 0.05 * steepest + 1e-5


def test_behind_a_wall_nothing_is_seen() -> None:
    """From 1 m up, a wall of 0.5 m whose top ends 2.05 m ahead hides level ground as far as 4.1 m ahead."""
    heights = np.zeros((256, 256))
    x = np.arange(256) * 0.1 - 12.75
    heights[:, (x > 1.8) & (x < 2.1)] = 0.5
    camera = replace(QUIET, position=(0.0, 0.0, 0.0))
    perceived = standing(camera, Heightfield(heights), 1.0)
    ahead = np.abs(LEFT) < 0.5 * FORWARD
    end = x[heights[0] > 0].max()
    # The edge is sampled every 8 cm, which the shadow doubles, and a cell is 10 cm.
    hidden = ahead & (end + 0.2 < FORWARD) & (2 * end - 0.3 > FORWARD)
    beyond = ahead & (2 * end + 0.15 < FORWARD) & (FORWARD < 5.5)
    before = ahead & (FORWARD > 1.2) & (FORWARD < 1.6)
    assert not perceived.valid[hidden].any()
    assert perceived.valid[beyond].mean() > 0.95
    assert perceived.valid[before].all()
    assert hidden.sum() > 300
    found = last_map(perceived, Heightfield(heights), 1.0)
    np.testing.assert_array_equal(found[hidden], np.float32(-1.0))  # filled with the ground below the base


def test_what_lies_beyond_the_map_is_not_entered_on_its_other_side() -> None:
    heights = np.zeros((256, 256))
    heights[:, np.arange(256) * 0.1 - 12.75 > 11.0] = 3.0
    perceived = standing(replace(QUIET, far=18.0), Heightfield(heights), 1.0)
    behind = FORWARD < -0.5
    assert not perceived.valid[behind].any()
    assert perceived.valid[~behind].sum() > 2000


def test_a_tower_taller_than_the_camera_is_seen_by_its_face() -> None:
    heights = np.zeros((256, 256))
    x = np.arange(256) * 0.1 - 12.75
    heights[:, (x > 2.0) & (x < 3.0)] = 4.0
    points = cloud(replace(QUIET, pitch=0.0), Heightfield(heights), (0.0, 0.0, 1.0))
    face = points[(points[:, 2] > 0.1)]
    assert len(face) > 100
    assert face[:, 2].max() < 1.0 + 2.2 * np.tan(np.deg2rad(29.0)) * 1.5
    assert np.ptp(face[:, 2]) > 1.0
    assert (face[:, 0] > 1.9).all()
    assert (face[:, 0] < 2.1).all()


def test_flying_pixels_lie_between_an_edge_and_what_it_hides() -> None:
    heights = np.zeros((256, 256))
    x = np.arange(256) * 0.1 - 12.75
    heights[:, (x > 1.8) & (x < 2.1)] = 0.5
    heightfield = Heightfield(heights)

    def floating(camera: DepthCamera) -> Array:
        points = cloud(camera, heightfield, (0.0, 0.0, 1.0))
        return points[points[:, 2] - heightfield.height(points[:, :2]) > 0.02]

    assert len(floating(QUIET)) == 0
    flying = floating(replace(QUIET, flying=1.0))
    assert len(flying) > 20
    assert flying[:, 2].max() < 0.5
    assert flying[:, 0].min() > 2.0


def test_dropout_and_blotches_leave_holes() -> None:
    count = {
        name: len(cloud(camera, FLAT, (0.0, 0.0, 1.0)))
        for name, camera in (
            ("all", QUIET),
            ("half", replace(QUIET, dropout=0.5)),
            ("blotched", replace(QUIET, blotches=30.0)),
        )
    }
    assert count["half"] == pytest.approx(count["all"] / 2, rel=0.05)
    assert 0.2 < count["blotched"] / count["all"] < 0.95


def test_flat_views_are_sparse() -> None:
    """From 0.3 m up, image rows are 8 cm apart on the ground at 3.3 m, and twice that by 4.7 m: r^2 / (h f)."""
    points = cloud(replace(QUIET, pitch=0.2), FLAT, (0.0, 0.0, 0.3))
    distance = np.hypot(points[:, 0], points[:, 1])
    per_metre = [((distance > low) & (distance < low + 0.5)).sum() for low in (2.5, 4.8)]
    rows = 0.3 * QUIET.focal * 0.08 / np.array([1.0, 5.05**2])
    assert rows[1] < 0.5
    # Beyond 3.3 m the share of samples that a row falls on is `rows`; before that it is one.
    assert per_metre[1] / per_metre[0] == pytest.approx(rows[1], rel=0.2)


def test_what_was_not_seen_for_a_second_is_forgotten() -> None:
    perceived = standing(QUIET, FLAT, 1.0)
    before = perceived.valid
    behind = np.array([0.0, 0.0, 0.0, 1.0])  # half a turn
    for k in range(1, 12):
        perceived.update(FLAT, (0, 0, 1.0), behind, np.pi, 1.0 + 0.1 * k)
        ahead_again = perceived.valid[::-1, ::-1]
        if k < 10:
            assert (ahead_again & before).sum() > 0.9 * before.sum()
    assert not (ahead_again & before & (FORWARD > 0.5)).any()


def test_fusing_averages_noise_away() -> None:
    camera = replace(QUIET, subpixel=0.2)
    errors = []
    for images in (1, 11):
        perceived = standing(camera, FLAT, 0.6, images)
        found = perceived.update(FLAT, (0, 0, 0.6), LEVEL, 0.0, 0.1 * (images - 1)) + 0.6
        far = perceived.valid & (FORWARD > 2.5)
        errors.append(found[far].std())
    assert errors[1] < 0.6 * errors[0]


def test_drift_blurs_and_a_pose_without_drift_does_not() -> None:
    def error(camera: DepthCamera) -> float:
        perceived = PerceivedMap(camera)
        perceived.reset(np.random.default_rng(1))
        for k in range(30):
            found = perceived.update(FLAT, (0, 0, 0.6), LEVEL, 0.0, 0.1 * k)
        return float(np.sqrt(((found[perceived.valid] + 0.6) ** 2).mean()))

    noisy = replace(QUIET, subpixel=0.08)
    assert error(replace(noisy, drift=0.1)) > 2 * error(noisy)


def test_a_long_walk_leaves_no_ghosts() -> None:
    """30 m at 3 m/s: the grid wraps around three times a direction, and what is valid is the ground that is there."""
    waves = Heightfield(np.sin(np.arange(500) * 0.1)[None, :] * 0.15 * np.ones((200, 1)), 0.1, (-5.0, -10.0))
    perceived = PerceivedMap(QUIET)
    perceived.reset(np.random.default_rng(0))
    for k in range(101):
        base = (0.3 * k, 0.04 * k, 0.8)
        found = perceived.update(waves, base, LEVEL, 0.3, 0.1 * k)
        error = np.abs(found - elevation(waves, base, 0.3))[perceived.valid]
        assert error.max() < 0.03
        assert len(error) > 1000


def test_images_are_taken_at_the_cameras_rate() -> None:
    perceived = PerceivedMap(replace(QUIET, rate=5.0, subpixel=0.1))
    perceived.reset(np.random.default_rng(0))
    maps = [perceived.update(FLAT, (0, 0, 0.6), LEVEL, 0.0, 0.02 * k) for k in range(31)]
    changed = [k for k in range(1, 31) if not np.array_equal(maps[k], maps[k - 1])]
    assert changed == [10, 20, 30]


def test_a_batch_is_its_robots_and_a_seed_is_a_seed() -> None:
    maps = [make("mixed", 0.7, seed) for seed in (0, 1, 2)]
    batch = PerceivedMap(num=3)
    batch.reset([np.random.default_rng(k) for k in range(3)])
    singles = [PerceivedMap() for _ in range(3)]
    for k, single in enumerate(singles):
        single.reset(np.random.default_rng(k))
    rng = np.random.default_rng(9)
    for step in range(8):
        xyz, yaw = rng.uniform(-1, 1, (3, 3)) + np.array([0, 0, 1.5]), rng.uniform(-1, 1, 3)
        quat = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=-1)
        if step == 4:  # one robot begins anew
            batch.reset([np.random.default_rng(7)] * 3, np.array([False, True, False]))
            singles[1].reset(np.random.default_rng(7))
        found = batch.update(maps, xyz, quat, yaw, 0.05 * step)
        for k, single in enumerate(singles):
            np.testing.assert_array_equal(found[k], single.update(maps[k], xyz[k], quat[k], yaw[k], 0.05 * step))
            np.testing.assert_array_equal(batch.valid[k], single.valid)


def test_a_reset_forgets_everything() -> None:
    perceived = standing(DepthCamera(), make("rough", 1.0, 0), 0.6)
    perceived.reset(np.random.default_rng(3))
    assert not perceived.valid.any()
    fresh = PerceivedMap()
    fresh.reset(np.random.default_rng(3))
    np.testing.assert_array_equal(
        perceived.update(FLAT, (0, 0, 0.6), LEVEL, 0.0, 0.0), fresh.update(FLAT, (0, 0, 0.6), LEVEL, 0.0, 0.0)
    )


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"near": 7.0}, "near 7.0 and far 6.0"),
        ({"fov": (4.0, 1.0)}, r"fov \(4.0, 1.0\)"),
        ({"position": (0, 0)}, "position"),
        ({"rate": 0.0}, "rate 0.0"),
        ({"dropout": 1.5}, "dropout 1.5"),
        ({"drift": -1.0}, "drift -1.0"),
        ({"tilt": float("nan")}, "tilt nan"),
        ({"pitch": float("nan")}, "pitch nan: want a finite number"),
        ({"pitch": "30"}, "pitch '30': want a finite number"),
        ({"fov": 1.0}, "fov 1.0: want 2 finite numbers"),
        ({"position": [[0], [1, 2], 3]}, "want 3 finite numbers"),
        ({"far": 1e9}, r"near 0.28 and far 1000000000.0: want 0 <= near < far <= 100 \[m\]"),
        ({"blotches": 1e9}, "blotches 1000000000.0: want 1000 or less"),
    ],
)
def test_impossible_cameras_are_refused(kwargs: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        DepthCamera(**kwargs)


def test_misuse_is_refused() -> None:
    perceived = PerceivedMap()
    with pytest.raises(InputError, match="update before reset"):
        perceived.update(FLAT, (0, 0, 1), LEVEL, 0.0, 0.0)
    perceived.reset(np.random.default_rng(0))
    perceived.update(FLAT, (0, 0, 1), LEVEL, 0.0, 1.0)
    with pytest.raises(InputError, match=r"time 0\.5 s is before"):
        perceived.update(FLAT, (0, 0, 1), LEVEL, 0.0, 0.5)
    with pytest.raises(InputError, match="finite"):
        perceived.update(FLAT, (0, 0, np.inf), LEVEL, 0.0, 2.0)
    with pytest.raises(InputError, match="unit quaternion"):
        perceived.update(FLAT, (0, 0, 1), (0, 0, 0, 0), 0.0, 2.0)
    with pytest.raises(InputError, match=r"want \(3,\), \(4,\), \(\)"):
        perceived.update(FLAT, np.zeros((2, 3)), LEVEL, 0.0, 2.0)
    batch = PerceivedMap(num=2)
    with pytest.raises(InputError, match="1 random generators for 2 robots"):
        batch.reset(np.random.default_rng(0))
    with pytest.raises(InputError, match="num 0"):
        PerceivedMap(num=0)


def test_some_robots_of_a_batch_look_while_the_others_wait() -> None:
    both, one = PerceivedMap(num=2), PerceivedMap(num=2)
    for each in (both, one):
        each.reset([np.random.default_rng(k) for k in range(2)])
    pose = (np.tile([0.0, 0.0, 0.5], (2, 1)), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)), np.zeros(2))
    for time in (0.0, 0.1):
        whole, part = both.update(FLAT, *pose, time), one.update(FLAT, *pose, time, np.array([False, True]))
        np.testing.assert_array_equal(part, whole[1:])
    np.testing.assert_array_equal(one.valid.any((1, 2)), [False, True])


def test_a_second_look_at_one_moment_changes_nothing_that_comes_later() -> None:
    once, twice = PerceivedMap(), PerceivedMap()
    for each in (once, twice):
        each.reset(np.random.default_rng(0))
    rough = make("rough", 0.5, 0)
    for k in range(6):
        for again in range(2):
            seen = twice.update(rough, (0.1 * k, 0, 0.6), LEVEL, 0.0, 0.05 * k)
            if not again:
                first = once.update(rough, (0.1 * k, 0, 0.6), LEVEL, 0.0, 0.05 * k)
            np.testing.assert_array_equal(seen, first)
