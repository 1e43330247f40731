"""Meshes in and out: round trips, sampling between points, holes, overhangs, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from nfc_gym.core.errors import InputError
from nfc_gym.terrain import Heightfield, from_mesh, make, to_mesh

pytestmark = pytest.mark.filterwarnings("error")  # a warning that a test does not ask for fails it

# Files of these formats hold float32: half a unit in the last place of 12.75 m is 5e-7 m, times the steepest slope.
FLOAT32 = 5e-7 * 10


def plate(size: float, z: float, centre: tuple[float, float] = (0.0, 0.0)) -> trimesh.Trimesh:
    """A level square, open, facing up."""
    half = size / 2
    corners = [
        (x + centre[0], y + centre[1], z) for x, y in ((-half, -half), (half, -half), (half, half), (-half, half))
    ]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def box(extents: tuple[float, float, float], centre: tuple[float, float, float]) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(extents)
    mesh.apply_translation(centre)
    return mesh


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".glb", ".ply"])
def test_round_trip_through_files(suffix: str, tmp_path: Path) -> None:
    heightfield = Heightfield(make("mixed", 1.0, 3, shape=(90, 120)).heights, 0.1, (3.0, -7.0))
    to_mesh(heightfield, tmp_path / f"ground{suffix}")
    back = from_mesh(tmp_path / f"ground{suffix}")
    assert back.origin == pytest.approx(heightfield.origin, abs=1e-5)
    assert np.abs(back.heights - heightfield.heights).max() < FLOAT32


def test_a_glb_file_has_y_up(tmp_path: Path) -> None:
    to_mesh(make("obstacles", 1.0, 0), tmp_path / "ground.glb")
    low, high = trimesh.load_scene(tmp_path / "ground.glb").bounds
    assert (high - low)[1] < 4.0 < 25.0 < (high - low)[2]


@pytest.mark.parametrize("kind", ["rough", "stones", "obstacles"])
def test_sampling_between_points_is_the_collision_surface(kind: str) -> None:
    heightfield = make(kind, 1.0, 2, shape=(60, 80))
    other = from_mesh(to_mesh(heightfield), shape=(101, 133), resolution=0.037, origin=(-2.31, -1.77))
    row, col = np.indices(other.heights.shape)
    xy = np.stack([-2.31 + 0.037 * col, -1.77 + 0.037 * row], axis=-1)
    # A point within 1e-3 cells of a fold may take the steeper side's plane.
    steepest = np.abs(np.diff(heightfield.heights)).max() * 2
    assert np.abs(other.heights - heightfield.height(xy)).max() < 1e-6 + 2e-3 * steepest


def test_few_large_triangles_cover_many_points() -> None:
    ramp = trimesh.Trimesh([(0, 0, 0), (10, 0, 5), (10, 10, 5), (0, 10, 0)], [[0, 1, 2], [0, 2, 3]], process=False)
    heights = from_mesh(ramp, shape=(90, 95), resolution=0.1, origin=(0.3, 0.4)).heights
    np.testing.assert_allclose(heights, np.broadcast_to(0.5 * (0.3 + 0.1 * np.arange(95)), (90, 95)), atol=1e-6)


def test_a_closed_solid_is_no_overhang_and_its_volume_is_the_integral() -> None:
    heightfield = make("steps", 0.8, 1, shape=(60, 60))
    solid = to_mesh(heightfield, base=0.5)
    assert solid.is_watertight
    mean_height = (heightfield.heights - heightfield.heights.min()).astype(float) + 0.5
    corners = mean_height[:-1, :-1], mean_height[1:, 1:], mean_height[:-1, 1:], mean_height[1:, :-1]
    # Each cell is two prisms whose triangles share the corners of the diagonal.
    volume = 0.01 * (2 * corners[0] + 2 * corners[1] + corners[2] + corners[3]).sum() / 6
    assert solid.volume == pytest.approx(volume, rel=1e-9)
    assert np.abs(from_mesh(solid, closed=True).heights - heightfield.heights).max() < 1e-6
    solid.invert()
    assert np.abs(from_mesh(solid).heights - heightfield.heights).max() < 1e-6


def test_a_hole_takes_the_nearest_height_and_is_said() -> None:
    heightfield = make("rough", 0.5, 0, shape=(40, 40))
    mesh = to_mesh(heightfield)
    centres = mesh.triangles_center
    mesh.update_faces(~((np.abs(centres[:, 0] - 1.0) < 0.3) & (np.abs(centres[:, 1] + 0.5) < 0.2)))
    with pytest.warns(UserWarning, match=r"of 1600 columns have no surface \(a hole\).*row \d+, column \d+"):
        filled = from_mesh(mesh, shape=(40, 40))
    different = filled.heights != heightfield.heights
    assert 0 < different.sum() < 40
    rows, cols = np.nonzero(different)
    around = heightfield.heights[rows.min() - 1 : rows.max() + 2, cols.min() - 1 : cols.max() + 2]
    assert around.min() <= filled.heights[different].min() <= filled.heights[different].max() <= around.max()


@pytest.mark.parametrize("solid", [False, True])
def test_an_overhang_keeps_the_top_and_is_said(solid: bool) -> None:
    if solid:
        mesh = trimesh.util.concatenate([box((4, 4, 1), (0, 0, -0.5)), box((0.95, 0.95, 0.2), (0.5, 0.5, 1.0))])
    else:
        mesh = trimesh.util.concatenate([plate(4.0, 0.0), plate(0.95, 1.1, (0.5, 0.5))])
    with pytest.warns(UserWarning, match=r"several surfaces above each other \(an overhang\)"):
        heights = from_mesh(mesh, shape=(41, 41)).heights
    covered = (np.abs(np.arange(-2, 2.05, 0.1) - 0.5) < 0.475).astype(float)
    np.testing.assert_allclose(heights, 1.1 * np.outer(covered, covered), atol=1e-6)


def test_units_are_scaled_and_mistaken_ones_are_hinted_at() -> None:
    heightfield = make("rough", 0.5, 0, shape=(50, 50))
    mesh = to_mesh(heightfield)
    mesh.apply_scale(1000.0)
    scaled = from_mesh(mesh, shape=(50, 50), scale=0.001)
    np.testing.assert_allclose(scaled.heights, heightfield.heights, atol=1e-6)
    with pytest.raises(InputError, match=r"another unit\? Pass scale=0.001"):
        from_mesh(mesh, shape=(50, 50))
    with pytest.raises(InputError, match=r"millimetres, pass scale=0.001"):
        from_mesh(mesh)
    mesh.apply_scale(1e-6)
    with pytest.raises(InputError, match=r"another unit\? Pass scale=1000"):
        from_mesh(mesh, shape=(50, 50))


def test_a_mesh_that_does_not_cover_the_field_is_refused() -> None:
    with pytest.raises(InputError, match=r"2 x 2 m, the field 25\.5 x 25\.5 m.*does not cover"):
        from_mesh(plate(2.0, 0.0), shape=(256, 256))
    with pytest.raises(InputError, match="does not cover"):
        from_mesh(plate(4.0, 0.0), shape=(20, 20), origin=(1.5, 0.0))


def test_an_open_mesh_is_refused_where_a_closed_one_is_asked_for() -> None:
    with pytest.raises(InputError, match="is open"):
        from_mesh(to_mesh(make("rough", 0.5, 0, shape=(20, 20))), closed=True)


def test_meshes_without_a_surface_are_refused() -> None:
    with pytest.raises(InputError, match="empty"):
        from_mesh(trimesh.Trimesh())
    wall = trimesh.Trimesh([(0, 0, 0), (4, 0, 0), (4, 0, 4), (4, 4, 4)], [[0, 1, 2]], process=False)
    wall.vertices[3] = (0, 4, 0)
    with pytest.raises(InputError, match=r"no surface|points of"):
        from_mesh(wall)
    with pytest.raises(InputError, match="not finite"):
        from_mesh(trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (0, np.nan, 0)], [[0, 1, 2]], process=False))


def test_files_that_are_none_are_refused(tmp_path: Path) -> None:
    (tmp_path / "broken.glb").write_bytes(b"not a mesh")
    (tmp_path / "empty.stl").write_bytes(b"")
    with pytest.raises(InputError, match=r"broken\.glb: cannot be read as GLB"):
        from_mesh(tmp_path / "broken.glb")
    with pytest.raises(InputError, match=r"empty\.stl"):
        from_mesh(tmp_path / "empty.stl")
    with pytest.raises(InputError, match="no such file"):
        from_mesh(tmp_path / "absent.ply")
    with pytest.raises(InputError, match=r"'\.step'.*\.stl, \.obj, \.glb, \.ply"):
        from_mesh(tmp_path / "part.step")
    with pytest.raises(InputError, match=r"'\.step'"):
        to_mesh(make("rough", 0.5, 0, shape=(5, 5)), tmp_path / "part.step")


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"up": "x"}, "up 'x'"),
        ({"scale": 0.0}, "scale 0.0"),
        ({"shape": (1, 5)}, r"\(1, 5\)"),
        ({"resolution": -1}, "-1"),
    ],
)
def test_unusable_arguments_are_refused(kwargs: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        from_mesh(plate(4.0, 0.0), **kwargs)
    with pytest.raises(InputError, match="base 0"):
        to_mesh(make("rough", 0.5, 0, shape=(5, 5)), base=0)
