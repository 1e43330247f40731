"""Maps of the robot's grid laid onto heightfields: the same places, for every heading, as `elevation` sees."""

import numpy as np
import pytest

from nfc_gym.core.errors import InputError
from nfc_gym.terrain import Heightfield, elevation, lay
from nfc_gym.terrain.lay import FADE

Array = np.ndarray
FLAT = Heightfield(np.zeros((256, 256)))
FORWARD = (np.arange(128)[:, None] - 63.5) * 0.1  # m
LEFT = (np.arange(128)[None, :] - 63.5) * 0.1
POSES = [((0.0, 0.0), 0.0), ((0.31, -0.47), np.pi / 2), ((-1.2, 2.3), 0.7), ((3.0, 1.0), -2.5), ((-2.0, -3.0), 3.1)]


def bump(forward: float, left: float) -> Array:
    """0.4 m high and 0.3 m wide, at a place of the robot's grid."""
    return 0.4 * np.exp(-((FORWARD - forward) ** 2 + (LEFT - left) ** 2) / (2 * 0.3**2))


@pytest.mark.parametrize(("xy", "yaw"), POSES)
@pytest.mark.parametrize(("forward", "left"), [(1.0, 0.0), (0.0, 1.0), (-2.0, 0.5)])
def test_a_bump_is_where_the_robot_has_it(xy: tuple[float, float], yaw: float, forward: float, left: float) -> None:
    field = lay(bump(forward, left), FLAT, xy, yaw)
    # x grows with the column, y with the row
    points = np.array(FLAT.origin)[:, None] + 0.1 * np.indices(field.shape)[::-1].reshape(2, -1)
    found = points @ field.ravel() / field.sum()
    x = xy[0] + forward * np.cos(yaw) - left * np.sin(yaw)
    y = xy[1] + forward * np.sin(yaw) + left * np.cos(yaw)
    np.testing.assert_allclose(found, (x, y), atol=1e-3)
    assert field.max() == pytest.approx(0.4, abs=0.4 * (0.1 / 0.3) ** 2)


@pytest.mark.parametrize(("xy", "yaw"), POSES)
def test_what_is_laid_is_what_is_perceived(xy: tuple[float, float], yaw: float) -> None:
    """Twice bilinear: off by two eighths of a cell's squared times the curvatures along both axes, at most."""
    patch = bump(1.0, -0.6) - bump(-2.0, 1.5)
    ground = Heightfield(lay(patch, FLAT, xy, yaw))
    curved = 0.4 / 0.3**2  # 1 / m, along either axis at a bump's top
    seen = elevation(ground, (*xy, 0.0), yaw)
    assert np.abs(seen - patch)[10:-10, 10:-10].max() < 2 * (2 * 0.1**2 / 8 * curved) + 1e-6
    again = lay(seen, FLAT, xy, yaw)
    assert np.abs(again - ground.heights).max() < 4 * (2 * 0.1**2 / 8 * curved)


def test_it_is_bilinear() -> None:
    """Against the definition in float64, at a coarser heightfield that lies elsewhere."""
    other = Heightfield(np.zeros((50, 70)), 0.23, (4.0, -9.0))
    patch, (x, y), yaw = np.random.default_rng(0).normal(size=(128, 128)), (11.0, -4.0), 0.4
    px = other.origin[0] + 0.23 * np.arange(70)[None, :] - x
    py = other.origin[1] + 0.23 * np.arange(50)[:, None] - y
    i = (np.cos(yaw) * px + np.sin(yaw) * py) / 0.1 + 63.5
    j = (-np.sin(yaw) * px + np.cos(yaw) * py) / 0.1 + 63.5
    inside = (i > 10) & (i < 116) & (j > 10) & (j < 116)  # where nothing fades
    a, b = np.floor(i[inside]).astype(int), np.floor(j[inside]).astype(int)
    u, v = i[inside] - a, j[inside] - b
    near = patch[a, b] * (1 - v) + patch[a, b + 1] * v
    far = patch[a + 1, b] * (1 - v) + patch[a + 1, b + 1] * v
    found = lay(patch, other, (x, y), yaw)
    assert inside.sum() > 1000
    np.testing.assert_allclose(found[inside], near * (1 - u) + far * u, atol=3e-4)
    outside = (i < -1) | (i > 128) | (j < -1) | (j > 128)
    assert outside.sum() > 100
    assert not found[outside].any()


def test_it_ends_in_no_cliff() -> None:
    """A residual of a metre all over: the steepest step from point to point is the fade's own, but for its corners."""
    field = lay(np.ones((128, 128)), FLAT, (0.2, -0.1), 0.6)
    assert field.max() == pytest.approx(1.0)
    assert max(np.abs(np.diff(field, axis=axis)).max() for axis in (0, 1)) < 1.001 * 0.1 / FADE
    assert not field[:, :20].any()


def test_a_batch_is_its_robots() -> None:
    rng = np.random.default_rng(1)
    patches, xy, yaw = rng.normal(size=(2, 3, 128, 128)), rng.uniform(-3, 3, (2, 3, 2)), rng.uniform(-3, 3, (2, 3))
    found = lay(patches, FLAT, xy, yaw)
    assert found.shape == (2, 3, 256, 256)
    for at in np.ndindex(2, 3):
        np.testing.assert_array_equal(found[at], lay(patches[at], FLAT, xy[at], yaw[at]))


@pytest.mark.parametrize(
    ("patch", "xy", "yaw", "message"),
    [
        (np.zeros((64, 64)), (0, 0), 0.0, r"patch has shape \(64, 64\)"),
        (np.zeros((2, 128, 128)), (0, 0), 0.0, "want"),
        (np.zeros((128, 128)), (0, 0, 0), 0.0, r"xy \(3,\)"),
        (np.full((128, 128), np.nan), (0, 0), 0.0, "finite"),
        (np.zeros((128, 128)), (0, np.inf), 0.0, "finite"),
        ("a", (0, 0), 0.0, "arrays of numbers"),
    ],
)
def test_what_is_no_map_or_pose_is_refused(patch: object, xy: object, yaw: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        lay(patch, FLAT, xy, yaw)  # type: ignore[arg-type]
