"""`ResidualTerrain` and `PerceiveTerrain`: the simulator's ground, and what the policy sees of it."""

import pickle
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from fakes import FakeEnv, Gaussian, NoModel, roll, same

import nfc_gym  # noqa: F401 (registers the ids)
from nfc_gym import terrain
from nfc_gym.core import Fidelity, InputError
from nfc_gym.wrappers import PerceiveTerrain, ResidualTerrain
from nfc_gym.wrappers.ground import read_ground

ROUGH = {"terrain_pool": 2, "difficulty": 0.3}
BOWL = np.fromfunction(lambda i, j: 0.001 * ((i - 128) ** 2 + (j - 128) ** 2) / 100, (256, 256))

# A ball above a heightfield of 21 x 21 cells of 0.1 m whose heights are a ramp from -0.2 to 0.2 m along x.
RAMP = """
<mujoco><option timestep=".005"/>
  <asset><hfield name="ramp" nrow="21" ncol="21" size="1 1 .4 .1" elevation="{}"/></asset>
  <worldbody><geom name="ground" type="hfield" hfield="ramp" pos="0 0 -.2"/>
    <body name="ball" pos="0 0 .15"><freejoint/><geom type="sphere" size=".1" mass="1"/></body></worldbody>
</mujoco>
""".format(" ".join(str(j / 20) for i in range(21) for j in range(21)))


def test_the_simulator_gets_the_residual_and_the_policy_does_not() -> None:
    bare, env = (
        gym.make("nfc_gym/JackalRough-v0", **ROUGH),
        ResidualTerrain(gym.make("nfc_gym/JackalRough-v0", **ROUGH), BOWL),
    )
    seen, _ = bare.reset(seed=3)
    told, _ = env.reset(seed=3)
    base, plain = env.unwrapped, bare.unwrapped
    np.testing.assert_allclose(base.heightfield.heights, plain.heightfield.heights + BOWL, atol=1e-6)
    np.testing.assert_array_equal(base.perceived.heights, plain.heightfield.heights)
    # The robot stands on the true ground; its map is of the perceived one, relative to where it stands.
    rise = base.data.qpos[2] - plain.data.qpos[2]
    assert rise == pytest.approx(terrain.Heightfield(BOWL).height(base.data.qpos[:2]), abs=0.01)
    np.testing.assert_allclose(told["elevation"] + rise, seen["elevation"], atol=1e-5)


@pytest.mark.parametrize("robot", ["Ant", "Jackal"])
def test_null_is_no_wrapper_bit_for_bit(robot: str) -> None:
    bare = gym.make(f"nfc_gym/{robot}Rough-v0", **ROUGH)
    env = ResidualTerrain(gym.make(f"nfc_gym/{robot}Rough-v0", **ROUGH), np.zeros((256, 256)))
    same(roll(env, 5), roll(bare, 5))
    same(env.reset()[0], bare.reset()[0])


def test_a_residual_is_drawn_for_each_episode() -> None:
    maps = np.stack([np.full((256, 256), h) for h in (0.1, 0.2, 0.3)])
    env = ResidualTerrain(gym.make("nfc_gym/JackalRough-v0", **ROUGH), maps)
    seen = {float(env.delta_e[0, 0]) for _ in range(30) if env.reset() is not None}
    assert seen == {0.1, 0.2, 0.3}
    env.reset(seed=5)
    first = env.delta_e
    env.reset(seed=5)
    np.testing.assert_array_equal(env.delta_e, first)


def test_heightfields_of_others_are_written_and_the_start_rises() -> None:
    bare, env = FakeEnv(RAMP), ResidualTerrain(FakeEnv(RAMP), 0.3 * np.ones((21, 21)))
    rest = []
    for each in (bare, env):
        start = each.reset(seed=0)[0]
        for _ in range(200):
            each.step(np.zeros(0))
        rest.append((start[2], each.unwrapped.data.qpos[2]))
    assert rest[1][0] - rest[0][0] == pytest.approx(0.3, abs=1e-6)
    assert rest[0][1] < 0.15


def test_what_lies_on_the_ground_lies_higher() -> None:
    """A ball in a trough comes to rest higher by the residual there."""
    trough = RAMP.replace(
        RAMP.split('elevation="')[1].split('"')[0],
        " ".join(str(abs(j - 10) / 10) for i in range(21) for j in range(21)),
    )
    heights = []
    for env in (FakeEnv(trough), ResidualTerrain(FakeEnv(trough), 0.25 * np.ones((21, 21)))):
        env.reset(seed=0)
        for _ in range(300):
            env.step(np.zeros(0))
        heights.append(env.unwrapped.data.qpos[2])
    assert heights[1] - heights[0] == pytest.approx(0.25, abs=2e-3)


def test_null_on_a_heightfield_of_others() -> None:
    same(roll(ResidualTerrain(FakeEnv(RAMP), np.zeros((21, 21))), 30), roll(FakeEnv(RAMP), 30))


def test_spec_and_pickle(tmp_path: Path) -> None:
    Fidelity(delta_e=BOWL).save(tmp_path / "ground.npz")
    env = ResidualTerrain(gym.make("nfc_gym/JackalRough-v0", **ROUGH), tmp_path / "ground.npz")
    expected = roll(env, 3)
    same(roll(pickle.loads(pickle.dumps(env)), 3), expected)
    same(roll(gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json())), 3), expected)


def test_bad_input_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="Rough"):
        ResidualTerrain(gym.make("nfc_gym/JackalFlat-v0"), BOWL)
    with pytest.raises(InputError, match=r"Ant-v5 has none"):
        ResidualTerrain(gym.make("Ant-v5"), BOWL)
    with pytest.raises(InputError, match="NoModel"):
        ResidualTerrain(NoModel(), BOWL)
    with pytest.raises(InputError, match=r"\(256, 256\)"):
        ResidualTerrain(gym.make("nfc_gym/JackalRough-v0", **ROUGH), BOWL[:100, :100])
    with pytest.raises(InputError, match="-5 to 11"):
        ResidualTerrain(gym.make("nfc_gym/JackalRough-v0", **ROUGH), BOWL + 30).reset()
    with pytest.raises(InputError, match="psi"):
        ResidualTerrain(FakeEnv(RAMP), Gaussian("psi", np.zeros(3), 1.0))


def test_a_camera_sees_the_perceived_ground() -> None:
    """Without noise, the cells that were seen are those of the true map."""
    quiet = {"drift": 0.0, "yaw_drift": 0.0}
    env = PerceiveTerrain(gym.make("nfc_gym/JackalRough-v0", **ROUGH), quiet)
    true = gym.make("nfc_gym/JackalRough-v0", **ROUGH)
    true.reset(seed=1)
    observation, _ = env.reset(seed=1)
    assert observation in env.observation_space
    for _ in range(20):
        expected = true.step(np.array([0.3, 0.1]))[0]
        observation = env.step(np.array([0.3, 0.1]))[0]
    same(observation["proprio"], expected["proprio"])
    error = (observation["elevation"] - expected["elevation"])[env.valid]
    assert env.valid.mean() > 0.02
    assert np.median(abs(error)) < 0.03
    same(env.reset(seed=1)[0], PerceiveTerrain(gym.make("nfc_gym/JackalRough-v0", **ROUGH), quiet).reset(seed=1)[0])


def test_a_camera_beneath_a_residual_terrain_does_not_see_it() -> None:
    seen, valid = [], []
    for residual in (np.zeros((256, 256)), 0.2 * np.ones((256, 256))):
        env = ResidualTerrain(PerceiveTerrain(gym.make("nfc_gym/JackalRough-v0", **ROUGH)), residual)
        observation, _ = env.reset(seed=1)
        seen.append(observation["elevation"] + env.unwrapped.data.qpos[2])
        valid.append(env.env.valid)
    both = valid[0] & valid[1]  # from 0.2 m higher it sees other cells
    assert both.sum() > 50
    assert np.median(abs(seen[0] - seen[1])[both]) < 0.05


@pytest.mark.parametrize(
    ("noise", "message"), [({"pitsch": 0.1}, "pitch"), ({"far": -1.0}, "far"), ({"rate": 0.0}, "rate")]
)
def test_a_camera_that_is_none_is_refused(noise, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PerceiveTerrain(gym.make("nfc_gym/JackalRough-v0", **ROUGH), noise)


def test_a_camera_needs_a_floating_base() -> None:
    xml = "<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>"
    with pytest.raises(InputError, match="free joint"):
        PerceiveTerrain(FakeEnv(xml))
    assert mujoco.MjModel.from_xml_string(xml).nv == 1


def test_a_stack_of_maps_is_not_taken_for_one() -> None:
    stacked = gym.wrappers.FrameStackObservation(gym.make("nfc_gym/JackalRough-v0", **ROUGH), 2)
    with pytest.raises(InputError, match=r"'elevation'.* shape \(2, 128, 128\), want \(128, 128\).*inside"):
        PerceiveTerrain(stacked)
    inside = gym.wrappers.FrameStackObservation(PerceiveTerrain(gym.make("nfc_gym/JackalRough-v0", **ROUGH)), 2)
    assert inside.reset(seed=0)[0]["elevation"].shape == (2, 128, 128)


def test_ground_on_a_placed_body_is_read_where_it_is() -> None:
    ramp = '<geom name="ground" type="hfield" hfield="ramp" pos="0 0 -.2"/>'
    placed = mujoco.MjModel.from_xml_string(RAMP.replace(ramp, f'<body pos="3 0 1">{ramp}</body>'))
    data = mujoco.MjData(placed)
    mujoco.mj_forward(placed, data)
    ground = read_ground(placed, "x")
    for x, y in ((3.01, 0.53), (3.47, -0.52), (2.52, 0.03)):
        above = mujoco.mj_rayHfield(placed, data, 0, np.array([x, y, 9.0]), np.array([0, 0, -1.0]), None)
        assert ground.height((x, y)) == pytest.approx(9 - above, abs=1e-6)
    plane = '<geom type="plane" pos="0 0 .5" size="1 1 1"/>'
    level = f'<mujoco><worldbody><body pos="0 0 2" {{}}>{plane}</body></worldbody></mujoco>'
    about_z = read_ground(mujoco.MjModel.from_xml_string(level.format('euler="0 0 30"')), "x")
    assert about_z.height((0.0, 0.0)) == pytest.approx(2.5)
    for xml, message in (
        (level.format('euler="0 10 0"'), "geom 0, the model's plane, is not level"),
        (
            RAMP.replace(ramp, f'<body euler="0 0 90">{ramp}</body>'),
            "geom 'ground', the model's heightfield, is turned",
        ),
        (RAMP.replace(ramp, f'<body mocap="true">{ramp}</body>'), "is on a body that moves"),
    ):
        with pytest.raises(InputError, match=message):
            read_ground(mujoco.MjModel.from_xml_string(xml), "x")
    with pytest.raises(InputError, match="must belong to the world body"):
        ResidualTerrain(FakeEnv(RAMP.replace(ramp, f'<body pos="3 0 1">{ramp}</body>')), np.zeros((21, 21)))


def test_the_callers_residual_is_added() -> None:
    env = ResidualTerrain(gym.make("nfc_gym/JackalRough-v0", **ROUGH), np.full((256, 256), 0.1))
    env.reset(seed=0, options={"terrain_residual": np.full((256, 256), 0.25)})
    base = env.unwrapped
    np.testing.assert_allclose(base.heightfield.heights - base.perceived.heights, 0.35, atol=1e-6)
    env.reset(seed=0, options={"terrain_residual": None})
    np.testing.assert_allclose(base.heightfield.heights - base.perceived.heights, 0.1, atol=1e-6)
    with pytest.raises(InputError, match=r"terrain_residual has shape \(\), want \(256, 256\)"):
        env.reset(options={"terrain_residual": 0.25})
