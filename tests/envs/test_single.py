"""The single environment: terrain, elevation maps, hooks, pictures."""

import sys
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

from nfc_gym import InputError, terrain
from nfc_gym.envs import render, screen, terrains

ROUGH = "nfc_gym/JackalRough-v0"


def made(name: str, **kwargs: Any) -> gymnasium.Env:
    return gymnasium.make(name, **({"terrain_pool": 3} | kwargs))


def slope() -> np.ndarray:
    """(256, 256) rising by 0.02 m a cell along x alone, 0 in the middle."""
    return np.tile(0.02 * (np.arange(256) - 127.5), (256, 1)).astype(np.float32)


def test_terrain_is_drawn_chosen_or_given_and_read_back() -> None:
    env = made(ROUGH)
    pool = [m.heights for m in terrain.pool(3, 0, 0.5, "mixed", scale=0.3)]
    drawn = set()
    for seed in range(12):
        env.reset(seed=seed)
        drawn |= {k for k, m in enumerate(pool) if np.array_equal(m, env.unwrapped.heightfield.heights)}
    assert drawn == {0, 1, 2}
    env.reset(options={"terrain_id": 2})
    np.testing.assert_array_equal(env.unwrapped.heightfield.heights, pool[2])
    env.reset(options={"heightfield": slope()})
    own = env.unwrapped
    np.testing.assert_array_equal(own.heightfield.heights, slope())
    assert own.heightfield.resolution == 0.1
    np.testing.assert_allclose(own.heightfield.origin, (-12.75, -12.75))
    held = own.model.hfield_data.reshape(256, 256) * own.model.hfield_size[0, 2] + own.model.geom("ground").pos[2]
    np.testing.assert_allclose(held, slope(), atol=1e-6)
    flat = made("nfc_gym/JackalFlat-v0").unwrapped
    flat.reset()
    assert flat.heightfield.heights.shape == (256, 256)
    assert not flat.heightfield.heights.any()


def test_a_pool_is_made_of_the_terrain_packages_maps_one_by_one() -> None:
    pool = terrains.Pool(5, 11, 0.7, "mixed", 0.5)
    for k, heightfield in enumerate(terrain.pool(5, 11, 0.7, "mixed", scale=0.5)):
        np.testing.assert_array_equal(pool.map(k).heights, heightfield.heights)
    assert pool.map(1) is pool.map(1)


def test_the_surface_that_robots_touch_is_the_one_that_laws_know() -> None:
    """Rays down onto the compiled ground meet it where `ground` says."""
    env = made("nfc_gym/AntRough-v0", difficulty=1.0)
    env.reset(seed=1)
    own = env.unwrapped
    points = np.random.default_rng(0).uniform(-12, 12, (200, 2))
    expected = own._ground(points)
    hit, group = np.zeros(1, np.int32), np.array([1, 0, 0, 0, 0, 0], np.uint8)
    for point, height in zip(points, expected, strict=True):
        start = np.array([*point, 10.0])
        distance = mujoco.mj_ray(own.model, own.data, start, np.array([0, 0, -1.0]), group, 1, -1, hit, None)
        assert 10.0 - distance == pytest.approx(height, abs=2e-6)


def test_the_elevation_map_lies_in_the_robots_frame() -> None:
    """On a plane that rises along the world's x by 0.2 m/m, cell (i, j) shows the plane below it, turned by the yaw."""
    env = made(ROUGH)
    for seed in range(4):
        obs, _ = env.reset(seed=seed, options={"heightfield": slope()})
        x, _, z = env.unwrapped.data.qpos[:3]
        w, qx, qy, qz = env.unwrapped.data.qpos[3:7]
        yaw = np.arctan2(2 * (w * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
        ahead, left = np.meshgrid((np.arange(128) - 63.5) * 0.1, (np.arange(128) - 63.5) * 0.1, indexing="ij")
        world_x = x + np.cos(yaw) * ahead - np.sin(yaw) * left
        np.testing.assert_allclose(obs["elevation"], 0.2 * world_x - z, atol=2e-5)
    flat = made("nfc_gym/QuadcopterFlat-v0")
    obs, _ = flat.reset(seed=0)
    np.testing.assert_allclose(obs["elevation"], -flat.unwrapped.data.qpos[2], rtol=1e-6)


def test_the_map_is_what_is_perceived_and_the_robot_stands_on_what_is_simulated() -> None:
    env = made(ROUGH)
    obs, _ = env.reset(seed=0, options={"heightfield": np.full((256, 256), 1.0), "perceived": np.zeros((256, 256))})
    home = env.unwrapped.robot.home[2]
    assert obs["proprio"][12] == pytest.approx(1.0 + home, abs=1e-5)
    np.testing.assert_allclose(obs["elevation"], -1.0 - home, atol=1e-5)
    for _ in range(20):
        obs, *_ = env.step(np.zeros(2))
    assert obs["proprio"][12] == pytest.approx(1.0 + home, abs=5e-3)
    obs, _ = env.reset(seed=0)
    assert env.unwrapped.perceived is env.unwrapped.heightfield


def test_a_slower_map_is_held_between_refreshes() -> None:
    fast, slow = made(ROUGH), made(ROUGH, elevation_hz=10)
    (a, _), (b, _) = fast.reset(seed=0), slow.reset(seed=0)
    maps = []
    for step in range(1, 13):
        np.testing.assert_array_equal(b["elevation"], a["elevation"] if (step - 1) % 5 == 0 else maps[-1])
        maps.append(b["elevation"].copy())
        b["elevation"][:] = np.nan  # what is done to a returned map never shows in a later one
        a, b = fast.step(np.ones(2))[0], slow.step(np.ones(2))[0]
    assert not np.array_equal(maps[0], maps[5])


def test_robots_start_on_the_ground_not_in_it() -> None:
    """Over seeds and maps: no contact deeper than the home pose's, and the wheels touch within a tenth of a second."""
    env = made(ROUGH, difficulty=1.0, context=["psi"])
    for seed in range(10):
        env.reset(seed=seed)
        data = env.unwrapped.data
        assert min((c.dist for c in data.contact), default=0.0) > -6e-3
        for _ in range(5):
            env.step(np.zeros(2))
        assert data.ncon >= 3


def test_hooks_act_before_every_physics_step() -> None:
    env = made("nfc_gym/QuadcopterFlat-v0", context=["psi"])
    env.reset(seed=0)
    own, times = env.unwrapped, []
    own.substep_hooks.append(lambda e: times.append(e.data.time))
    env.step(np.zeros(4))
    np.testing.assert_allclose(times, [0, 0.005, 0.01, 0.015], atol=1e-12)
    own.substep_hooks.clear()
    own.after_hooks.append(lambda e: times.append(e.data.time))
    env.step(np.zeros(4))
    assert times[4:] == pytest.approx([0.04]), "and after the last, with or without others"
    own.after_hooks.clear()
    own.control_hooks.append(lambda e: times.append((e.data.time, *e.data.ctrl)))
    env.step(np.ones(4))
    assert times[5][0] == pytest.approx(0.04), "once, before the first"
    assert times[5][1:] == tuple(own.model.actuator_ctrlrange[:, 1]), "with the command that is about to act"
    assert len(times) == 6
    own.control_hooks.clear()

    def lift(e: Any) -> None:
        e.data.xfrc_applied[1, 2] = 9.81 * e.model.body("base").subtreemass[0]

    env.reset(seed=0)
    own.substep_hooks[:] = [lift]
    height = own.data.qpos[2]
    own.data.act[:] = 0
    for _ in range(10):
        env.step(-np.ones(4))
    assert own.data.qpos[2] == pytest.approx(height, abs=0.02), "weight held by the hook, rotors off"


def test_edits_through_fields_end_with_the_episode() -> None:
    env = made("nfc_gym/JackalFlat-v0", context=["psi"])
    env.reset(seed=0)
    own = env.unwrapped
    for _ in range(3):
        own.fields["body_ipos"][1, 0] += 0.05
        own.fields["geom_size"][0, 0] *= 2
        own.fields.commit()
        env.reset()
    np.testing.assert_array_equal(own.model.body_ipos, own.fields.nominal("body_ipos"))
    np.testing.assert_array_equal(own.model.geom_size, own.fields.nominal("geom_size"))


# ---- pictures -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pictured() -> gymnasium.Env:
    env = made(ROUGH, render_mode="rgb_array", width=160, height=120, camera={"distance": 8.0, "elevation": -30})
    env.reset(seed=0)
    try:
        env.render()
    except Exception as error:  # no graphics library at all
        pytest.skip(f"cannot render here: {error}")
    return env


def test_a_changed_heightfield_is_seen(pictured: gymnasium.Env) -> None:
    flat = {"heightfield": np.zeros((256, 256), np.float32)}
    pictured.reset(seed=0, options=flat)
    before = pictured.render()
    assert before.shape == (120, 160, 3)
    assert before.dtype == np.uint8
    assert before.std() > 5, "a picture, not one colour"
    pictured.reset(seed=0, options=flat)
    np.testing.assert_array_equal(pictured.render(), before)
    wall = np.zeros((256, 256), np.float32)
    wall[100:110] = 3.0
    pictured.reset(seed=0, options={"heightfield": wall})
    changed = np.abs(pictured.render().astype(int) - before).max(-1) > 20
    assert changed.mean() > 0.05
    own = pictured.unwrapped
    own.model.hfield_data[:] = (0 + 5) / 16  # written behind the environment's back, as wrappers may
    np.testing.assert_array_equal(pictured.render(), before)


def test_a_picture_too_large_to_draw_is_told(pictured: gymnasium.Env) -> None:
    env = made(ROUGH, render_mode="rgb_array", width=300_000, height=200_000)
    env.reset(seed=0)
    before = (env.unwrapped.model.vis.global_.offwidth, env.unwrapped.model.vis.global_.offheight)
    with pytest.raises(InputError, match="width 300000 and height 200000: no picture of that size"):
        env.render()
    assert (env.unwrapped.model.vis.global_.offwidth, env.unwrapped.model.vis.global_.offheight) == before
    env.close()
    assert pictured.render().shape == (120, 160, 3)


def test_a_changed_camera_is_seen(pictured: gymnasium.Env) -> None:
    pictured.reset(seed=0)
    before = pictured.render()
    pictured.unwrapped.screen.camera = {"distance": 2.0, "azimuth": 30.0, "trackbody": "base"}
    near = pictured.render()
    pictured.unwrapped.screen.camera = "track"
    assert (np.abs(near.astype(int) - before) > 20).mean() > 0.1
    assert (np.abs(pictured.render().astype(int) - near) > 20).mean() > 0.1
    for camera, message in (("moon", "the scene has track"), ({"zoom": 2}, "no 'zoom'; it has lookat")):
        pictured.unwrapped.screen.camera = camera
        with pytest.raises(InputError, match=message):
            pictured.render()
    pictured.unwrapped.screen.camera = "track"


def test_pictures_of_a_vector_environment(pictured: gymnasium.Env) -> None:
    envs = gymnasium.make_vec(ROUGH, num_envs=2, terrain_pool=2, render_mode="rgb_array", width=160, height=120)
    envs.reset(seed=0, options={"terrain_id": np.array([0, 1])})
    first, second = envs.render()
    single = made(ROUGH, terrain_pool=2, render_mode="rgb_array", width=160, height=120)
    single.reset(seed=1, options={"terrain_id": 1})
    assert (np.abs(single.render().astype(int) - second) > 8).mean() < 0.01
    assert (np.abs(first.astype(int) - second) > 8).mean() > 0.05
    single.close()
    envs.close()


@pytest.fixture
def contexts(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The graphics contexts that are open, none of which is real."""
    there: list[Any] = []

    class Context:
        def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
            self.model = model
            there.append(self)

        def render(self, model: mujoco.MjModel, data: mujoco.MjData, camera: Any) -> np.ndarray:
            assert model.nhfield == self.model.nhfield
            return np.zeros((480, 640, 3), np.uint8)

        def close(self) -> None:
            there.remove(self)

    monkeypatch.setattr(screen, "Pictures", Context)
    return there


def test_pictures_are_of_the_terrains_that_there_are(contexts: list[Any]) -> None:
    envs = gymnasium.make_vec(ROUGH, num_envs=1, terrain_pool=2, render_mode="rgb_array", context=["psi"])
    envs.reset(seed=0)
    envs.render()
    for count in (1, 3):
        envs.unwrapped.set_terrains([np.zeros((256, 256), np.float32)] * count)
        envs.reset(seed=0)
        envs.render()
        assert [each.model.nhfield for each in contexts] == [count]
    envs.close()


def test_what_is_opened_again_is_closed_again(contexts: list[Any]) -> None:
    name, arguments = "nfc_gym/JackalFlat-v0", {"render_mode": "rgb_array", "context": []}
    for env in (made(name, **arguments), gymnasium.make_vec(name, num_envs=1, **arguments)):
        for _ in range(2):
            env.reset(seed=0)
            env.render()
            assert len(contexts) == 1
            env.close()
            assert not contexts


def test_pictures_show_the_state_as_it_is_and_as_a_vector_row_does() -> None:
    """After a step what MuJoCo derives from the state is a physics step old."""
    flat = {"render_mode": "rgb_array", "width": 160, "height": 120, "context": []}
    single = made("nfc_gym/JackalFlat-v0", **flat)
    envs = gymnasium.make_vec("nfc_gym/JackalFlat-v0", num_envs=1, **flat)
    single.reset(seed=3)
    envs.reset(seed=3)
    for _ in range(5):
        single.step(np.array([1.0, 0.5]))
        envs.step(np.array([[1.0, 0.5]]))
    np.testing.assert_array_equal(single.render(), envs.render()[0])  # type: ignore[index]
    before = single.unwrapped.data.xpos.copy()  # type: ignore[attr-defined]
    single.render()
    np.testing.assert_array_equal(single.unwrapped.data.xpos, before)  # type: ignore[attr-defined]
    single.close()
    envs.close()


def test_a_list_of_pictures_is_gymnasiums() -> None:
    env = made("nfc_gym/JackalFlat-v0", render_mode="rgb_array_list", width=32, height=24, context=[])
    env.reset(seed=0)
    env.step(np.zeros(2))
    assert [p.shape for p in env.render()] == 2 * [(24, 32, 3)]  # type: ignore[union-attr]
    env.close()


def test_a_window_without_a_display_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    if not sys.platform.startswith("linux"):
        pytest.skip("other systems have displays of their own")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    env = made("nfc_gym/JackalFlat-v0", render_mode="human", context=[])
    with pytest.raises(InputError, match=r'opens a window, and there is no display .* use "rgb_array"'):
        env.reset(seed=0)


def test_the_window_is_sent_changed_heights(monkeypatch: pytest.MonkeyPatch) -> None:
    """`human` drives MuJoCo's passive viewer; here a stand-in of it notes what it is told."""
    import mujoco.viewer

    told: list[Any] = []

    class Handle:
        cam = mujoco.MjvCamera()

        def lock(self) -> Any:
            import contextlib

            return contextlib.nullcontext()

        def update_hfield(self, k: int) -> None:
            told.append(k)

        def sync(self) -> None:
            told.append("sync")

        def close(self) -> None:
            told.append("close")

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(mujoco.viewer, "launch_passive", lambda *args, **kwargs: Handle())
    env = made(ROUGH, render_mode="human")
    env.reset(seed=0, options={"terrain_id": 0})
    env.step(np.zeros(2))
    env.reset(options={"terrain_id": 1})
    env.close()
    assert told == ["sync", "sync", 0, "sync", "close"]
    assert int(Handle.cam.fixedcamid) == env.unwrapped.model.camera("track").id


def test_cameras_of_any_scene() -> None:
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(InputError, match="the scene has none"):
        render.camera_of(model, "track")


@pytest.mark.parametrize("seed", [3, None])
@pytest.mark.parametrize(
    "options",
    [
        {"psi": {"base_mass": -1.0}},
        {"terrain_id": 7},
        {"perceived": np.zeros(3)},
        {"terrain_residual": np.full((256, 256), 50.0)},
        {"terrain_residual": np.zeros(3)},
    ],
    ids=["psi", "terrain_id", "perceived", "too_high", "shape"],
)
def test_a_reset_that_is_refused_changes_nothing(options: dict[str, Any], seed: int | None) -> None:
    env, twin = (made(ROUGH, context=["psi"]) for _ in range(2))
    for each in (env, twin):
        each.reset(seed=0)
    with pytest.raises(InputError):
        env.reset(seed=seed, options=options)
    assert env.unwrapped.np_random_seed == 0
    for a, b in ((env.step(np.ones(2))[0], twin.step(np.ones(2))[0]), (env.reset()[0], twin.reset()[0])):
        np.testing.assert_array_equal(a["proprio"], b["proprio"])


def test_what_was_closed_is_not_stepped() -> None:
    name = "nfc_gym/JackalFlat-v0"
    for env in (made(name, context=["psi"]), gymnasium.make_vec(name, num_envs=2, context=["psi"])):
        env.reset(seed=0)
        env.close()
        with pytest.raises(gymnasium.error.ClosedEnvironmentError, match="closed: reset"):
            env.step(np.zeros(env.action_space.shape))
        env.reset(seed=0)
        env.step(np.zeros(env.action_space.shape))


def test_an_autoreset_mode_that_is_none_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="autoreset_mode is 'foo', want one of: NextStep, SameStep, Disabled"):
        gymnasium.make_vec("nfc_gym/JackalFlat-v0", num_envs=2, autoreset_mode="foo")


def test_seeds_are_whole_numbers_of_any_kind() -> None:
    env = made("nfc_gym/JackalFlat-v0", context=["psi"]).unwrapped
    first, _ = env.reset(seed=3)
    for seed in (np.int64(3), np.uint8(3), np.array(3)):
        np.testing.assert_array_equal(env.reset(seed=seed)[0]["proprio"], first["proprio"])  # type: ignore[arg-type]
        assert env.np_random_seed == 3
    for wrong in (-1, 1.5, "3"):
        with pytest.raises(gymnasium.error.Error):
            env.reset(seed=wrong)  # type: ignore[arg-type]
