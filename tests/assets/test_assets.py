"""The robots compile, are complete and physically valid, stand still, and do what their documentation says."""

import tomllib
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from nfc_gym import assets
from nfc_gym.core.errors import InputError

MASS = {"ant": 8.2, "humanoid": 40.6, "jackal": 17.0, "quadcopter": 1.0, "quadruped": 12.0}  # kg, as documented
PSI_SIZE = {"ant": 21, "humanoid": 37, "jackal": 17, "quadcopter": 9, "quadruped": 13}
BODIES = {"ant": 13, "humanoid": 16, "jackal": 5, "quadcopter": 5, "quadruped": 17}
ROOT = {"ant": "torso", "humanoid": "torso", "jackal": "base", "quadcopter": "base", "quadruped": "base"}
CORNERS = ("front_left", "front_right", "rear_left", "rear_right")
TRUNK = ["abdomen_z", "abdomen_y", "abdomen_x"]
LEG = ("hip_x", "hip_z", "hip_y", "knee", "ankle_y", "ankle_x")
ARM = ("shoulder1", "shoulder2", "elbow")
ACTUATORS = {
    "ant": [f"{leg}_{joint}" for leg in CORNERS for joint in ("hip", "ankle")],
    "humanoid": TRUNK + [f"{side}_{joint}" for limb in (LEG, ARM) for side in ("right", "left") for joint in limb],
    "jackal": ["front_left", "front_right", "rear_left", "rear_right"],
    "quadcopter": ["front_left", "front_right", "rear_left", "rear_right"],
    "quadruped": [f"{leg}_{joint}" for leg in ("FL", "FR", "RL", "RR") for joint in ("abduction", "hip", "knee")],
}
NAMED = ("body", "jnt", "geom", "site", "actuator", "sensor", "cam", "light", "mat", "tex", "key")


@pytest.fixture(params=assets.ROBOTS)
def robot(request: pytest.FixtureRequest) -> str:
    return request.param


def load(robot: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_path(str(assets.path(robot)))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    return model, data


def psi(robot: str) -> list[dict[str, Any]]:
    return tomllib.loads((assets.path(robot).parent / "psi.toml").read_text())["parameter"]


def nominal(model: mujoco.MjModel, field: str, name: str) -> float:
    """The value that psi's field has in the compiled model, in the field's own unit."""
    if field == "servo_kv":
        gain, bias = model.actuator(name).gainprm[0], model.actuator(name).biasprm[2]
        assert bias == -gain
        return gain
    if field == "servo_kp":
        gain, bias = model.actuator(name).gainprm[0], model.actuator(name).biasprm[1]
        assert bias == -gain
        return gain
    if field == "geom_restitution":
        table = restitution_table()
        zeta = model.geom(name).solref[1] / (-2 * table["omega"])
        return float(np.interp(zeta, table["zeta"][::-1], table["restitution"][::-1]))
    kind, _, attribute = field.partition("[")[0].partition("_")
    index = int(field[field.index("[") + 1 : -1]) if "[" in field else 0
    return float(np.ravel(getattr(getattr(model, "joint" if kind == "jnt" else kind)(name), attribute))[index])


def restitution_table() -> dict[str, Any]:
    return tomllib.loads((assets.path("jackal").parents[1] / "restitution.toml").read_text())


def test_path_names_the_robots_for_an_unknown_one() -> None:
    with pytest.raises(InputError, match=r"'husky'.*ant, humanoid, jackal, quadcopter, quadruped"):
        assets.path("husky")
    assert all(isinstance(assets.path(name), Path) and assets.path(name).is_file() for name in assets.ROBOTS)


def test_every_element_is_named(robot: str) -> None:
    model, _ = load(robot)
    for kind in NAMED:
        count = getattr(model, {"actuator": "nu", "jnt": "njnt"}.get(kind, f"n{kind}"))
        addresses = np.atleast_1d(getattr(model, f"name_{kind}adr"))
        names = [model.names[a : model.names.index(b"\0", a)] for a in addresses[:count]]
        assert all(names), f"{kind} without a name"
        assert len(set(names)) == len(names)


def test_contract_of_names_and_options(robot: str) -> None:
    model, _ = load(robot)
    assert [model.actuator(i).name for i in range(model.nu)] == ACTUATORS[robot]
    assert int(model.jnt_type[model.joint("root").id]) == int(mujoco.mjtJoint.mjJNT_FREE)
    assert model.body(model.jnt_bodyid[model.joint("root").id]).name == ROOT[robot]
    assert model.nbody - 1 == BODIES[robot]
    assert int(model.geom("ground").type[0]) == int(mujoco.mjtGeom.mjGEOM_PLANE)
    assert model.opt.timestep == 0.005
    assert int(model.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    assert model.camera("track").id >= 0
    assert model.site("imu").id >= 0
    assert model.nmesh == 0
    for sensor in ("imu_gyro", "imu_accelerometer", "imu_quat", "imu_velocity"):
        assert model.sensor(sensor).id >= 0


def test_inertias_are_complete_and_valid(robot: str) -> None:
    model, _ = load(robot)
    assert model.body_mass[1:].sum() == pytest.approx(MASS[robot], rel=1e-6)
    for body in range(1, model.nbody):
        mass, inertia = model.body_mass[body], np.sort(model.body_inertia[body])
        assert mass > 0
        assert inertia[0] > 0
        assert inertia[2] < inertia[0] + inertia[1], model.body(body).name
        # A body's radii of gyration lie within the reach of its own geoms.
        geoms = np.flatnonzero(model.geom_bodyid == body)
        reach = max(np.linalg.norm(model.geom_pos[g] - model.body_ipos[body]) + model.geom_rbound[g] for g in geoms)
        assert np.sqrt(inertia[2] / mass) < reach, model.body(body).name


def test_inertia_is_mirror_symmetric(robot: str) -> None:
    """Left and right halves weigh the same: the centre of mass lies on the middle plane, for the base frame's y."""
    model, data = load(robot)
    assert data.subtree_com[model.body(ROOT[robot]).id][1] == pytest.approx(0.0, abs=1e-6)


def test_home_is_an_equilibrium(robot: str) -> None:
    model, data = load(robot)
    start, moved = data.qpos.copy(), np.zeros(model.nv)
    for _ in range(200):
        mujoco.mj_step(model, data)
    mujoco.mj_differentiatePos(model, moved, 1.0, start, data.qpos)
    assert np.abs(moved).max() < 1e-5
    assert np.abs(data.qvel).max() < 1e-4


def test_robot_geoms_never_touch_one_another(robot: str) -> None:
    model, _ = load(robot)
    solid = (model.geom_contype > 0) | (model.geom_conaffinity > 0)
    own = solid & (model.geom_bodyid > 0)
    assert own.any()
    assert not model.geom_contype[own].any()
    assert (model.geom_conaffinity[own] == 1).all()
    assert (model.geom_priority[own] == 1).all()


def test_psi_resolves_and_contains_the_nominal(robot: str) -> None:
    model, _ = load(robot)
    parameters = psi(robot)
    assert len(parameters) == PSI_SIZE[robot] == len({p["name"] for p in parameters})
    for p in parameters:
        assert p["unit"]
        assert p["reason"]
        assert p["low"] < p["high"]
        values = [nominal(model, p["field"], name) for name in p["of"]]
        assert np.ptp(values) == 0, "one value is written to all of them"
        assert p["low"] < values[0] < p["high"], p["name"]
        if "nominal" in p:
            assert values[0] == pytest.approx(p["nominal"], abs=5e-3)
