"""Ego-centric maps: orientation, bilinear interpolation, edges, batches."""

import numpy as np
import pytest

from nfc_gym.core.errors import InputError
from nfc_gym.terrain import KINDS, Heightfield, elevation, make

Array = np.ndarray


def looked_up(heightfield: Heightfield, xyz: tuple[float, float, float], yaw: float) -> Array:
    """The same map by its definition, in float64."""
    forward = (np.arange(128)[:, None] - 63.5) * 0.1
    left = (np.arange(128)[None, :] - 63.5) * 0.1
    x = xyz[0] + np.cos(yaw) * forward - np.sin(yaw) * left
    y = xyz[1] + np.sin(yaw) * forward + np.cos(yaw) * left
    nrow, ncol = heightfield.heights.shape
    col = np.clip((x - heightfield.origin[0]) / heightfield.resolution, 0, ncol - 1)
    row = np.clip((y - heightfield.origin[1]) / heightfield.resolution, 0, nrow - 1)
    c, r = np.minimum(col.astype(int), ncol - 2), np.minimum(row.astype(int), nrow - 2)
    u, v, h = col - c, row - r, heightfield.heights.astype(np.float64)
    near, far = h[r, c] * (1 - u) + h[r, c + 1] * u, h[r + 1, c] * (1 - u) + h[r + 1, c + 1] * u
    return near * (1 - v) + far * v - xyz[2]


POSES = [
    ((0.0, 0.0, 0.5), 0.0),
    ((1.234, -2.3, 0.5), 0.7),
    ((-3.21, 4.56, -0.2), 2.0),
    ((12.0, 9.0, 1.0), -2.5),  # half of it beyond the edge
    ((30.0, -40.0, 1.0), 3.1),  # all of it
]


@pytest.mark.parametrize(("xyz", "yaw"), POSES)
@pytest.mark.parametrize("kind", KINDS)
def test_maps_are_bilinear_look_ups(kind: str, xyz: tuple[float, float, float], yaw: float) -> None:
    """OpenCV places points in float32: within 3e-5 cells along either axis at 300 cells from its origin."""
    heightfield = make(kind, 0.7, 3)
    steepest = sum(np.abs(np.diff(heightfield.heights, axis=axis)).max() for axis in (0, 1))
    found = elevation(heightfield, xyz, yaw)
    assert found.dtype == np.float32
    assert np.abs(found - looked_up(heightfield, xyz, yaw)).max() < 3e-5 * steepest + 2.5e-7


@pytest.mark.parametrize(("xyz", "yaw"), POSES)
def test_maps_are_exact_to_a_micrometre_on_gentle_ground(xyz: tuple[float, float, float], yaw: float) -> None:
    heightfield = make("rough", 0.5, 0)
    assert np.abs(elevation(heightfield, xyz, yaw) - looked_up(heightfield, xyz, yaw)).max() < 1e-6


def test_forward_is_along_rows_and_left_along_columns() -> None:
    """A post 2 m ahead and 1 m to the left of a robot that faces along y."""
    heights = np.zeros((256, 256))
    x, y = -1.05 + 0.3, 1.95 - 0.2  # of the post, in the world
    heights[round((y + 12.75) / 0.1), round((x + 12.75) / 0.1)] = 5.0
    base = (x + 1.05, y - 1.95, 0.5)  # half a cell from the grid, as the map's own cells are
    found = elevation(Heightfield(heights), base, np.pi / 2)
    assert np.unravel_index(found.argmax(), found.shape) == (83, 74)
    assert found.max() == pytest.approx(4.5, abs=1e-3)


def test_other_resolutions_and_origins() -> None:
    coarse = Heightfield(make("rough", 1.0, 0, shape=(60, 50), resolution=0.3).heights, 0.3, (5.0, -20.0))
    found = elevation(coarse, (12.0, -11.0, 0.0), 1.0)
    assert np.abs(found - looked_up(coarse, (12.0, -11.0, 0.0), 1.0)).max() < 5e-6


def test_a_batch_is_its_robots_bit_for_bit() -> None:
    maps = [make("mixed", 0.8, seed) for seed in (0, 1)]
    rng = np.random.default_rng(0)
    xyz, yaw = rng.uniform(-8, 8, (7, 3)), rng.uniform(-np.pi, np.pi, 7)
    chosen = [maps[k] for k in rng.integers(0, 2, 7)]
    found = elevation(chosen, xyz, yaw)
    for k in range(7):
        np.testing.assert_array_equal(found[k], elevation(chosen[k], xyz[k], yaw[k]))
    same = elevation(maps[0], xyz, yaw)
    np.testing.assert_array_equal(same, elevation([maps[0]] * 7, xyz, yaw))
    assert elevation(maps[0], xyz[:0], yaw[:0]).shape == (0, 128, 128)


def test_arrays_are_fresh_unless_one_is_given() -> None:
    heightfield = make("rough", 0.5, 0)
    first = elevation(heightfield, (0, 0, 0), 0.0)
    kept = first.copy()
    out = np.empty((128, 128), np.float32)
    assert elevation(heightfield, (3, 0, 0), 0.0, out=out) is out
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(out, elevation(heightfield, (3, 0, 0), 0.0))


def test_what_does_not_fit_is_refused() -> None:
    heightfield = make("rough", 0.5, 0)
    with pytest.raises(InputError, match=r"\(2,\) and yaw \(\)"):
        elevation(heightfield, (0, 0), 0.0)
    with pytest.raises(InputError, match="finite"):
        elevation(heightfield, (0, np.nan, 0), 0.0)
    with pytest.raises(InputError, match=r"xyz is 'abc' and yaw 0\.0; want arrays of numbers"):
        elevation(heightfield, "abc", 0.0)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="heightfield is None; want a Heightfield"):
        elevation(None, (0, 0, 0), 0.0)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="1 heightfields for 2 robots"):
        elevation([heightfield], np.zeros((2, 3)), np.zeros(2))
    with pytest.raises(InputError, match="out is float64"):
        elevation(heightfield, (0, 0, 0), 0.0, out=np.empty((128, 128)))  # type: ignore[arg-type]
