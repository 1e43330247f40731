"""No robot starts in the ground, whatever the terrain, and none starts far above it."""

import mujoco
import numpy as np
import pytest

from nfc_gym import assets, terrain
from nfc_gym.envs import scene
from nfc_gym.envs.ant import Ant
from nfc_gym.envs.humanoid import Humanoid
from nfc_gym.envs.quadruped import Quadruped
from nfc_gym.envs.robot import Robot
from nfc_gym.envs.spawn import place, underside


@pytest.mark.parametrize("kind", [Ant, Humanoid, Quadruped])
@pytest.mark.parametrize("ground", ["rough", "steps", "slopes", "stones", "gaps"])
def test_starts_just_above_the_harshest_ground(kind: type[Robot], ground: str) -> None:
    """No level patch to start on; thirty starts a map, each checked against MuJoCo's own collisions."""
    model = scene.build(assets.path(kind.name), maps=1)
    robot = kind(model, kind.tasks[0])
    field = terrain.make(ground, 1.0, seed=3, spawn=0.0)
    scene.write(model, 0, field.heights)
    data = mujoco.MjData(model)
    margin = model.geom_margin.copy()
    u = np.random.default_rng(0).random((30, kind.draws))
    starts = robot.begin(u, field.height).qpos
    for qpos in starts:
        data.qpos[:] = qpos
        model.geom_margin[:] = margin
        mujoco.mj_forward(model, data)
        assert data.ncon == 0 or data.contact.dist.min() > 0
        # The lowest foot is within 0.2 m of the ground: contacts appear once geoms are inflated by that much.
        model.geom_margin[:] = 0.2
        mujoco.mj_forward(model, data)
        assert data.ncon > 0


@pytest.mark.parametrize("kind", [Ant, Humanoid, Quadruped])
def test_one_start_is_a_row_of_many_to_the_bit(kind: type[Robot]) -> None:
    model = mujoco.MjModel.from_xml_path(str(assets.path(kind.name)))
    robot = kind(model, kind.tasks[0])
    field = terrain.make("rough", 1.0, seed=0)
    u = np.random.default_rng(0).random((9, kind.draws))
    many = robot.begin(u, field.height)
    for i in range(9):
        one = robot.begin(u[i], field.height)
        np.testing.assert_array_equal(one.qpos, many.qpos[i])
        for name, value in one.task.items():
            np.testing.assert_array_equal(value, many.task[name][i])


def test_underside_is_below_every_geom() -> None:
    """Capsules, spheres and boxes of the Quadruped: the lowest sample is the feet's lowest point."""
    model = mujoco.MjModel.from_xml_path(str(assets.path("quadruped")))
    home = model.key("home").qpos
    below = underside(model, home)
    data = mujoco.MjData(model)
    data.qpos[:] = home
    mujoco.mj_kinematics(model, data)
    feet = [data.geom(f"{leg}_foot").xpos[2] - 0.023 for leg in ("FL", "FR", "RL", "RR")]
    assert below[:, 2].min() == pytest.approx(min(feet) - home[2], abs=1e-9)


def test_on_a_slope_the_robot_is_lifted_by_its_uphill_side() -> None:
    """Points at x = +-1 below a root 0.5 m above them, on ground that rises by 0.2 a metre, heading +y and +x."""
    below = np.array([[1.0, 0.0, -0.5], [-1.0, 0.0, -0.5]])
    home = np.array([0, 0, 0.5, 1, 0, 0, 0], float)
    heading = np.array([0.0, np.pi / 2])
    qpos = place(home, below, np.full(2, 3.0), np.zeros(2), heading, lambda xy: 0.2 * xy[..., 0], 0.01)
    np.testing.assert_allclose(qpos[:, 2], [0.5 + 0.2 * 4 + 0.01, 0.5 + 0.2 * 3 + 0.01])
    np.testing.assert_allclose(qpos[1, 3:], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
