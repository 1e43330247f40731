"""The legged robots stand, fall without gaining energy, feel their weight at the feet, and are alike on both sides."""

import itertools
import tomllib

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from nfc_gym import assets

GRAVITY = 9.81
FEET = {
    "ant": ["front_left_foot", "front_right_foot", "rear_left_foot", "rear_right_foot"],
    "humanoid": ["right_foot", "left_foot"],
}
WALKERS = ("ant", "humanoid", "quadruped")
# Joints that change sign in a mirror; all others of a left and right pair have the same sign.
FLIP = {"ant": "hip", "humanoid": "abdomen_z abdomen_x", "quadruped": "abduction"}


def load(robot: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The robot at rest in its keyframe."""
    model = mujoco.MjModel.from_xml_path(str(assets.path(robot)))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    return model, data


def names_of_psi(robot: str) -> list[str]:
    return [p["name"] for p in tomllib.loads((assets.path(robot).parent / "psi.toml").read_text())["parameter"]]


def other_side(robot: str, name: str) -> str:
    """The name of an element's mirror image."""
    left, right = {"ant": ("_left", "_right"), "humanoid": ("left_", "right_"), "quadruped": ("L_", "R_")}[robot]
    return name.replace(left, right) if left in name else name.replace(right, left)


def sign(robot: str, joint: str) -> int:
    return -1 if any(joint.endswith(end) for end in FLIP[robot].split()) else 1


def mirror(robot: str, model: mujoco.MjModel, q: NDArray, v: NDArray) -> tuple[NDArray, NDArray]:
    """A state seen in a mirror that stands along x, z."""
    mq, mv = q.copy(), v.copy()
    mq[:7] *= [1, -1, 1, 1, -1, 1, -1]  # polar vector, axial vector of the rotation
    mv[:6] *= [1, -1, 1, -1, 1, -1]
    for j in range(1, model.njnt):
        name = model.joint(j).name
        twin = model.joint(other_side(robot, name))
        mq[twin.qposadr[0]] = sign(robot, name) * q[model.jnt_qposadr[j]]
        mv[twin.dofadr[0]] = sign(robot, name) * v[model.jnt_dofadr[j]]
    return mq, mv


def test_psi_is_in_the_documented_order() -> None:
    """Masses from the torso outwards, then stiffnesses; the Humanoid's in the order of its bodies and joints."""
    corners = ("front_left", "front_right", "rear_left", "rear_right")
    ant = ["torso_mass", *(f"{c}_{part}_mass" for part in ("hip", "leg", "foot") for c in corners)]
    ant += [f"{c}_{joint}_stiffness" for joint in ("hip", "ankle") for c in corners]
    assert names_of_psi("ant") == ant
    legs = ("FL", "FR", "RL", "RR")
    quadruped = ["base_mass", *(f"{leg}_{part}_mass" for part in ("thigh", "shank") for leg in legs)]
    assert names_of_psi("quadruped") == quadruped + [f"{leg}_hip_stiffness" for leg in legs]
    model, _ = load("humanoid")
    humanoid = [f"{model.body(i).name}_mass" for i in range(1, model.nbody)]
    assert names_of_psi("humanoid") == humanoid + [f"{model.joint(i).name}_stiffness" for i in range(1, model.njnt)]


@pytest.mark.parametrize("robot", WALKERS)
def test_both_sides_move_alike(robot: str) -> None:
    """Mirrored start and mirrored commands give the mirrored motion, through fall and contact."""
    model, data = load(robot)
    twin = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    data.qpos[2] += 0.05
    data.qpos[3:7] = [0.99, 0.1, 0.05, -0.08]
    data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    data.qvel[:6] = [0.4, 0.2, 0.0, 0.3, -0.2, 0.5]
    twin.qpos[:], twin.qvel[:] = mirror(robot, model, data.qpos, data.qvel)
    names = [model.actuator(i).name for i in range(model.nu)]
    home = model.key("home").ctrl
    for _ in range(20):
        data.ctrl[:] = home + rng.uniform(-0.2, 0.2, model.nu)
        for i, name in enumerate(names):
            twin.ctrl[names.index(other_side(robot, name))] = sign(robot, name) * data.ctrl[i]
        mujoco.mj_step(model, data, nstep=4)
        mujoco.mj_step(model, twin, nstep=4)
    assert data.ncon > 0
    q, v = mirror(robot, model, data.qpos, data.qvel)
    np.testing.assert_allclose(twin.qpos, q, atol=1e-4)
    np.testing.assert_allclose(twin.qvel, v, atol=1e-2)


@pytest.mark.parametrize("robot", ["ant", "humanoid"])
def test_psi_is_alike_on_both_sides(robot: str) -> None:
    model, _ = load(robot)
    for kind, fields in {
        "body": ("mass", "inertia"),
        "joint": ("stiffness", "range", "damping", "armature"),
        "actuator": ("gear",),
    }.items():
        count = {"body": model.nbody, "joint": model.njnt, "actuator": model.nu}[kind]
        for i in range(count):
            here = getattr(model, kind)(i)
            twin = getattr(model, kind)(other_side(robot, here.name))
            for field in fields:
                np.testing.assert_array_equal(getattr(here, field), getattr(twin, field), err_msg=here.name)


@pytest.mark.parametrize("robot", ["ant", "humanoid"])
@pytest.mark.parametrize(("height", "tilt"), list(itertools.product((0.05, 0.5), (0.0, 0.7, 2.0))))
def test_a_drop_gains_no_energy_and_comes_to_rest(robot: str, height: float, tilt: float) -> None:
    """Unpowered, from any attitude: no bounce carries more energy than the fall, nothing sinks in or jitters."""
    model, data = load(robot)
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data.ctrl[:] = 0
    axis = np.array([1.0, 0.5, 0.2]) / np.linalg.norm([1.0, 0.5, 0.2])
    data.qpos[2] += height + (0.6 if tilt else 0.0)
    data.qpos[3:7] = [np.cos(tilt / 2), *np.sin(tilt / 2) * axis]
    mujoco.mj_forward(model, data)
    start = data.energy.sum()
    highest = -np.inf
    for _ in range(1200):
        mujoco.mj_step(model, data)
        highest = max(highest, data.energy.sum())
    assert highest < start + 1e-6
    assert data.energy[1] < 0.05  # J
    assert data.contact.dist.min() > -0.002  # m
    assert not any(w.number for w in data.warning)


@pytest.mark.parametrize("robot", WALKERS)
def test_feet_of_a_standing_robot_sink_by_less_than_a_millimetre(robot: str) -> None:
    model, data = load(robot)
    mujoco.mj_step(model, data, nstep=50)
    assert data.ncon >= 4
    assert -0.001 < data.contact.dist.min() < 0


def test_the_ant_rests_on_its_feet_alone_over_the_prior() -> None:
    """The heaviest torso on the weakest springs still hangs clear of the ground, feet less than 2 mm in it."""
    model, data = load("ant")
    model.body("torso").mass[0] = 6.0
    model.jnt_stiffness[1:] = 0.5
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_step(model, data, nstep=400)
    touching = {model.geom(g).name for c in data.contact for g in c.geom} - {"ground"}
    assert touching == set(FEET["ant"])
    assert data.qpos[2] == pytest.approx(0.36, abs=5e-3)
    assert data.contact.dist.min() > -0.002


def test_the_humanoid_stands_under_position_control() -> None:
    """Springs of 400 N m/rad around home hold it for five seconds, with the prior's heaviest torso."""
    model, data = load("humanoid")
    model.body("torso").mass[0] = 14.0
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    home = data.qpos[7:].copy()
    model.jnt_stiffness[1:], model.dof_damping[6:], model.qpos_spring[7:] = 400.0, 15.0, home
    mujoco.mj_step(model, data, nstep=1000)
    assert data.qpos[2] == pytest.approx(model.key("home").qpos[2], abs=0.03)
    assert np.abs(data.qvel).max() < 1e-2


@pytest.mark.parametrize("robot", ["ant", "humanoid"])
def test_feet_carry_the_weight(robot: str) -> None:
    """At rest, what the feet pass on, turned into the world's frame, is the weight of all that stands on them."""
    model, data = load(robot)
    mujoco.mj_forward(model, data)
    total = np.zeros(3)
    for foot in FEET[robot]:
        force, torque = data.sensor(f"{foot}_force").data, data.sensor(f"{foot}_torque").data
        assert force.shape == torque.shape == (3,)
        total += data.site(foot).xmat.reshape(3, 3) @ force
    carried = model.body_mass.sum() - sum(model.body(foot).mass[0] for foot in FEET[robot])
    assert abs(total[2]) == pytest.approx(carried * GRAVITY, rel=1e-3)
    np.testing.assert_allclose(total[:2], 0, atol=0.05)


def test_positive_angles_bend_spread_and_turn_outward() -> None:
    """The signs that the Humanoid's file promises, each joint by 0.3 rad from the straight pose."""
    model, data = load("humanoid")

    def moved(joint: str, body: str) -> NDArray:
        data.qpos[:] = [0, 0, 1.3, 1, 0, 0, 0, *np.zeros(21)]
        mujoco.mj_kinematics(model, data)
        start = data.xpos[model.body(body).id].copy()
        data.qpos[model.joint(joint).qposadr[0]] = 0.3
        mujoco.mj_kinematics(model, data)
        return data.xpos[model.body(body).id] - start

    for side, out in (("left", 1), ("right", -1)):
        assert moved(f"{side}_hip_y", f"{side}_shin")[0] > 0.1  # forward
        assert moved(f"{side}_knee", f"{side}_foot")[0] < -0.1  # back
        assert moved(f"{side}_elbow", f"{side}_hand")[0] > 0.05
        assert moved(f"{side}_shoulder1", f"{side}_hand")[0] > 0.1
        assert out * moved(f"{side}_hip_x", f"{side}_shin")[1] > 0.1
        assert out * moved(f"{side}_shoulder2", f"{side}_hand")[1] > 0.1
        data.qpos[7:] = 0
        data.qpos[model.joint(f"{side}_hip_z").qposadr[0]] = 0.3
        data.qpos[model.joint(f"{side}_ankle_y").qposadr[0]] = 0.3
        mujoco.mj_kinematics(model, data)
        toes = data.xmat[model.body(f"{side}_foot").id].reshape(3, 3)[:, 0]
        assert out * toes[1] > 0.2
        assert toes[2] > 0.2
    assert moved("abdomen_y", "pelvis")[0] > 0.02  # the trunk being the root, the legs come forward under it


@pytest.mark.parametrize("leg", FEET["ant"])
def test_ants_ankles_bend_down(leg: str) -> None:
    model, data = load("ant")
    mujoco.mj_kinematics(model, data)
    joint = model.joint(leg.replace("foot", "ankle")).qposadr[0]
    before = data.site(leg).xpos[2]
    data.qpos[joint] += 0.3
    mujoco.mj_kinematics(model, data)
    assert data.site(leg).xpos[2] < before - 0.1
