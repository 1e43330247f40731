"""The surface between grid points against MuJoCo's rays and contacts, and heightfields written into models."""

import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from nfc_gym.core.errors import InputError
from nfc_gym.terrain import Heightfield, asset, make, surface, write, write_pool

ROOT = Path(__file__).resolve().parents[2]


def compiled(*maps: Heightfield) -> mujoco.MjModel:
    """A world with one heightfield geom, `ground`, of the first map, and a small ball in the air."""
    spec = mujoco.MjSpec()
    for k, heightfield in enumerate(maps):
        data = asset(heightfield)
        spec.add_hfield(name=f"map{k}", nrow=data.nrow, ncol=data.ncol, size=data.size, userdata=data.data)
    spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="map0", pos=asset(maps[0]).pos)
    spec.worldbody.add_geom(name="post", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 0.1], pos=[30, 0, 0])
    ball = spec.worldbody.add_body(name="ball", pos=[0, 0, 9])
    ball.add_freejoint()
    ball.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.001, 0, 0])
    return spec.compile()


def rays(model: mujoco.MjModel, xy: np.ndarray, top: float = 20.0) -> np.ndarray:
    """Height of the first surface below each point, by MuJoCo's own ray caster."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    ball = model.body("ball").id
    down, hit, normal = np.array([0, 0, -1.0]), np.zeros(1, np.int32), np.zeros(3)
    found = []
    for x, y in xy:
        distance = mujoco.mj_ray(model, data, np.array([x, y, top]), down, None, 1, ball, hit, normal)
        assert hit[0] == model.geom("ground").id
        found.append([top - distance, *normal])
    return np.array(found)


@pytest.fixture(scope="module")
def jagged() -> Heightfield:
    """No cell is flat or symmetrical; the map is neither square nor centred nor above zero."""
    return Heightfield(np.random.default_rng(0).normal(size=(17, 24)), 0.25, (-1.0, 3.0))


@pytest.mark.parametrize("kind", ["jagged", "mixed", "obstacles"])
def test_height_and_normal_are_those_of_mujocos_rays(kind: str, jagged: Heightfield) -> None:
    heightfield = jagged if kind == "jagged" else make(kind, 0.8, seed=1)
    low = np.array(heightfield.origin)
    xy = np.random.default_rng(1).uniform(low + 1e-6, low + heightfield.extent - 1e-6, (2000, 2))
    seen = rays(compiled(heightfield), xy)
    np.testing.assert_allclose(heightfield.height(xy), seen[:, 0], atol=1e-6, rtol=0)
    np.testing.assert_allclose(heightfield.normal(xy), seen[:, 1:], atol=1e-5, rtol=0)


def test_one_point_at_a_time_is_the_same_to_the_bit(jagged: Heightfield) -> None:
    low = np.array(jagged.origin) - 1.0
    points = np.random.default_rng(2).uniform(low, low + jagged.extent + 2.0, (3000, 2))
    assert [jagged.height_at(x, y) for x, y in points.tolist()] == jagged.height(points).tolist()


def test_contacts_see_the_same_diagonal_as_rays() -> None:
    """A saddle: along one diagonal the surface is a ridge at 1 m, along the other it would be a valley at 0 m."""
    saddle = Heightfield([[1, 0], [0, 1]], 1.0)
    model = compiled(saddle)
    data = mujoco.MjData(model)
    for z, touches in ((0.99, True), (1.01, False)):
        data.qpos[:3] = 0, 0, z
        mujoco.mj_forward(model, data)
        assert (data.ncon > 0) == touches
    assert saddle.height([0, 0]) == 1.0


def test_points_beyond_the_edge_take_the_edges_height(jagged: Heightfield) -> None:
    (west, south), (along, across) = jagged.origin, jagged.extent
    y = south + 0.37 * across
    assert jagged.height([west - 5, y]) == jagged.height([west, y])
    assert jagged.height([west + along + 1e6, y]) == jagged.height([west + along, y])
    assert jagged.height([west - 5, south - 5]) == np.float64(jagged.heights[0, 0])
    assert jagged.height([west + along, south + across]) == np.float64(jagged.heights[-1, -1])


def test_any_batch_shape_and_a_stack_of_maps() -> None:
    maps = [make("rough", 1.0, seed, shape=(20, 30)) for seed in range(3)]
    stack = np.stack([m.heights for m in maps])
    xy = np.random.default_rng(0).uniform(-1.5, 1.5, (5, 4, 2))
    which = np.array([2, 0, 1, 1, 2])
    heights = surface(stack, xy, maps[0].resolution, maps[0].origin, which[:, None])[0]
    np.testing.assert_array_equal(heights, np.stack([maps[k].height(p) for k, p in zip(which, xy, strict=True)]))
    assert maps[0].height([0.1, 0.2]).shape == ()
    assert maps[0].normal(xy).shape == (5, 4, 3)


def test_written_model_is_the_compiled_one() -> None:
    """All fields that a map touches: a stale bounding box would lose contacts above the first map's top."""
    low, tall = make("rough", 0.1, seed=0), make("steps", 1.0, seed=3)
    moved = Heightfield(tall.heights, 0.1, (2.0, -5.0))
    written, fresh = compiled(low), compiled(moved)
    write(written, "map0", moved)
    for name in ("hfield_data", "hfield_size", "geom_pos", "geom_size", "geom_aabb", "geom_rbound", "bvh_aabb"):
        np.testing.assert_allclose(getattr(written, name), getattr(fresh, name), atol=1e-6, err_msg=name)
    np.testing.assert_array_equal(rays(written, [(3.3, 1.1)]), rays(fresh, [(3.3, 1.1)]))


def test_flat_maps_are_written_too() -> None:
    model = compiled(make("mixed", 1.0, seed=0))
    for level in (0.0, -3.5):
        write(model, "map0", Heightfield(np.full((256, 256), level)))
        np.testing.assert_allclose(rays(model, np.array([[0.0, 0.0], [5.0, -7.0]]))[:, 0], level, atol=1e-6)


def test_a_pool_serves_one_geom() -> None:
    maps = [make(kind, 0.7, seed=2, shape=(64, 64)) for kind in ("gaps", "steps", "rough")]
    model = compiled(*maps)
    write_pool(model, ["map0", "map1", "map2"], maps)
    xy = np.random.default_rng(3).uniform(-3, 3, (200, 2))
    for k, heightfield in enumerate(maps):
        model.geom("ground").dataid = model.hfield(f"map{k}").id
        np.testing.assert_allclose(rays(model, xy)[:, 0], heightfield.height(xy), atol=1e-6, rtol=0)


@pytest.mark.parametrize("xy", [(np.nan, 0.0), 5, "ab", np.zeros(3), [[0.0, 0.0], [np.inf, 0.0]]])
def test_what_is_no_point_is_refused(xy: object) -> None:
    heightfield = make("rough", 0.5, 0, shape=(16, 16))
    for ask in (heightfield.height, heightfield.normal):
        with pytest.raises(InputError, match=r"xy is .*; want finite world points \(\.\.\., 2\)"):
            ask(xy)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("heights", "resolution", "origin", "message"),
    [
        (np.zeros(4), 0.1, None, r"\(4,\)"),
        (np.zeros((1, 5)), 0.1, None, "at least 2"),
        ([[0, np.nan], [0, 0]], 0.1, None, r"heights\[0, 1\] is nan"),
        (np.zeros((2, 2)), 0.0, None, "resolution 0.0"),
        (np.zeros((2, 2)), "fine", None, "resolution 'fine'"),
        ("flat", 0.1, None, "heights are 'flat'; want an array of numbers"),
        ([[1, 2], [3]], 0.1, None, r"heights are \[\[1, 2\], \[3\]\]; want"),
        (np.zeros((2, 2), complex), 0.1, None, "(?s)heights are array.*; want an array of numbers"),
        (np.zeros((2, 2)), 0.1, 5, "origin 5: want the world x and y"),
        (np.zeros((2, 2)), 0.1, (0, np.inf), "origin"),
    ],
)
def test_unusable_maps_are_refused(heights: np.ndarray, resolution: float, origin: tuple, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Heightfield(heights, resolution, origin)


def test_unusable_models_are_refused() -> None:
    heightfield = make("rough", 0.5, seed=0, shape=(16, 16))
    model = compiled(heightfield)
    with pytest.raises(InputError, match=r"'ground2'.*'map0'"):
        write(model, "ground2", heightfield)
    with pytest.raises(InputError, match=r"\(8, 16\).*\(16, 16\)"):
        write(model, "map0", make("rough", 0.5, seed=0, shape=(8, 16)))
    model.geom("ground").quat = [0.8, 0.6, 0, 0]
    with pytest.raises(InputError, match="'ground'"):
        write(model, "map0", heightfield)


def test_heights_cannot_be_changed_behind_its_back() -> None:
    mine = np.zeros((4, 4), np.float32)
    heightfield = Heightfield(mine)
    mine[0, 0] = 1.0
    assert heightfield.heights[0, 0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        heightfield.heights[0, 0] = 1.0


def test_simulations_of_a_batch_stand_on_maps_of_their_own() -> None:
    """A ball on a vertical slide comes to rest one radius, along the normal, off its own map's surface."""
    maps = [make(kind, 0.6, seed=4, shape=(64, 64)) for kind in ("rough", "slopes", "mixed")]
    radius, x, y = 0.05, 1.93, -1.37
    spec = mujoco.MjSpec()
    for k, heightfield in enumerate(maps):
        data = asset(heightfield)
        spec.add_hfield(name=f"map{k}", nrow=data.nrow, ncol=data.ncol, size=data.size, userdata=data.data)
    spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="map0")
    ball = spec.worldbody.add_body(name="ball", pos=[x, y, 0])
    ball.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1], damping=[2.0, 0.0, 0.0])
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], mass=0.1, friction=[0, 0, 0])
    model = spec.compile()
    write_pool(model, ["map0", "map1", "map2"], maps)
    batch = Batch(model, nsim=3, nthread=1)
    batch.expand("geom_dataid")[:, model.geom("ground").id] = [model.hfield(f"map{k}").id for k in range(3)]
    batch.bind("qpos")[:] = 1.5
    for _ in range(3000):
        batch.step()
    grounds = [float(m.height([x, y])) for m in maps]
    assert np.ptp(grounds) > 0.05
    for rest, heightfield, ground in zip(batch.bind("qpos")[:, 0], maps, grounds, strict=True):
        assert rest - ground == pytest.approx(radius / heightfield.normal([x, y])[2], abs=0.004)


def test_importing_needs_neither_mujoco_nor_trimesh() -> None:
    code = "import nfc_gym.terrain, sys; print({'mujoco', 'trimesh', 'scipy', 'torch'} & set(sys.modules))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert out.stdout.strip() == "set()"
