"""A compiled MuJoCo model as URDF: links, joints, inertias and the shapes that collide."""

from collections.abc import Sequence
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.measured.hidden import Array

TINY = 1e-6  # kg and kg m^2 of a link that only joins two hinges of one body: Bullet has no joints of several axes
GEOM = mujoco.mjtGeom


def _numbers(values: Array | Sequence[float]) -> str:
    return " ".join(f"{float(v):.9g}" for v in values)


def _rpy(quat: Array) -> Array:
    """Roll, pitch, yaw of a quaternion, w first: what URDF's `rpy` means, Rz Ry Rx."""
    m = np.zeros(9)
    mujoco.mju_quat2Mat(m, quat)
    m = m.reshape(3, 3)
    pitch = np.arcsin(np.clip(-m[2, 0], -1, 1))
    if abs(m[2, 0]) > 1 - 1e-9:
        return np.array([np.arctan2(-m[1, 2], m[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(m[2, 1], m[2, 2]), pitch, np.arctan2(m[1, 0], m[0, 0])])


def _origin(parent: Element, pos: Array, quat: Array) -> None:
    SubElement(parent, "origin", xyz=_numbers(pos), rpy=_numbers(_rpy(quat)))


def _inertial(link: Element, mass: float, inertia: Array, pos: Array, quat: Array) -> None:
    part = SubElement(link, "inertial")
    _origin(part, pos, quat)
    SubElement(part, "mass", value=f"{mass:.9g}")
    x, y, z = (f"{v:.9g}" for v in inertia)
    SubElement(part, "inertia", ixx=x, iyy=y, izz=z, ixy="0", ixz="0", iyz="0")


def _shape(link: Element, model: mujoco.MjModel, geom: int) -> None:
    kind, size, quat = int(model.geom_type[geom]), model.geom_size[geom], model.geom_quat[geom].copy()
    collision = SubElement(link, "collision", name=model.geom(geom).name)
    if kind == int(GEOM.mjGEOM_ELLIPSOID):
        # Bullet has none. A disc about the shortest axis: a tyre, or the plane that a propeller sweeps.
        short = int(size.argmin())
        kind, flat = int(GEOM.mjGEOM_CYLINDER), size
        size = np.array([flat.max(), flat[short], 0.0])
        turn = {0: [np.sqrt(0.5), 0, np.sqrt(0.5), 0], 1: [np.sqrt(0.5), -np.sqrt(0.5), 0, 0], 2: [1.0, 0, 0, 0]}[short]
        mujoco.mju_mulQuat(quat, model.geom_quat[geom], np.array(turn))
    _origin(collision, model.geom_pos[geom], quat)
    shape = SubElement(collision, "geometry")
    if kind == int(GEOM.mjGEOM_BOX):
        SubElement(shape, "box", size=_numbers(2 * size))
    elif kind == int(GEOM.mjGEOM_SPHERE):
        SubElement(shape, "sphere", radius=_numbers(size[:1]))
    elif kind in (int(GEOM.mjGEOM_CYLINDER), int(GEOM.mjGEOM_CAPSULE)):
        name = "cylinder" if kind == int(GEOM.mjGEOM_CYLINDER) else "capsule"
        SubElement(shape, name, radius=_numbers(size[:1]), length=_numbers(2 * size[1:2]))
    else:
        raise InputError(f"geom {model.geom(geom).name!r} is of a shape that URDF has not")


def colliding(model: mujoco.MjModel, body: int) -> list[int]:
    """Geoms of a body that touch the ground."""
    return [g for g in range(model.ngeom) if model.geom_bodyid[g] == body and model.geom_conaffinity[g] > 0]


def _link(robot: Element, model: mujoco.MjModel, body: int) -> None:
    link = SubElement(robot, "link", name=model.body(body).name)
    inertia = np.maximum(model.body_inertia[body], TINY)
    _inertial(link, max(model.body_mass[body], TINY), inertia, model.body_ipos[body], model.body_iquat[body])
    for geom in colliding(model, body):
        _shape(link, model, geom)


def with_rotors(model: mujoco.MjModel, body: int) -> Array:
    """(3,) a body's inertia with that of the rotors behind its joints' gears: Bullet's joints have none.

    No URDF may hold it, as no rigid body has so much inertia about one axis alone.
    """
    out = model.body_inertia[body].copy()
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[body])
    for j in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
        along = turn.reshape(3, 3).T @ model.jnt_axis[j]
        out += model.dof_armature[model.jnt_dofadr[j]] * along**2
    return out


def to_urdf(model: mujoco.MjModel) -> str:
    """URDF of a model's only robot.

    Args:
      model: one tree with a free joint at its root; elsewhere slides, and hinges through their bodies' origins.

    Returns:
      The text. Drives, damping, stiffness and friction are left to whoever simulates it.

    Raises:
      InputError: another kind of joint, or of shape.
    """
    robot = Element("robot", name="robot")
    for body in range(1, model.nbody):
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        free = count == 1 and int(model.jnt_type[first]) == int(mujoco.mjtJoint.mjJNT_FREE)
        _link(robot, model, body)
        if not free:
            _join(robot, model, body, list(range(first, first + count)))
    indent(robot)  # Bullet reads by lines, and breaks one after 8191 characters wherever that is: within a number too
    return tostring(robot, encoding="unicode")


def _join(robot: Element, model: mujoco.MjModel, body: int, joints: list[int]) -> None:
    above, pos, quat = model.body(model.body_parentid[body]).name, model.body_pos[body], model.body_quat[body]
    names = [model.body(body).name] if not joints else [
        model.body(body).name if j == joints[-1] else f"{model.joint(j).name}_link" for j in joints]  # fmt: skip
    for name, j in zip(names, joints or [None], strict=True):
        if name != model.body(body).name:
            _inertial(
                SubElement(robot, "link", name=name), TINY, np.full(3, TINY), np.zeros(3), np.array([1.0, 0, 0, 0])
            )
        joint = SubElement(robot, "joint", name=f"{name}_mount" if j is None else model.joint(j).name)
        joint.set("type", "fixed" if j is None else _kind(model, j))
        _origin(joint, pos, quat)
        SubElement(joint, "parent", link=above)
        SubElement(joint, "child", link=name)
        if j is not None:
            SubElement(joint, "axis", xyz=_numbers(model.jnt_axis[j]))
            low, high = model.jnt_range[j] if model.jnt_limited[j] else (0.0, -1.0)  # the wrong way round: no limit
            SubElement(joint, "limit", lower=f"{low:.9g}", upper=f"{high:.9g}", effort="1e6", velocity="1e3")
        above, pos, quat = name, np.zeros(3), np.array([1.0, 0, 0, 0])


def _kind(model: mujoco.MjModel, j: int) -> str:
    """URDF's word for a joint."""
    kind, limited = int(model.jnt_type[j]), bool(model.jnt_limited[j])
    if kind == int(mujoco.mjtJoint.mjJNT_SLIDE):
        return "prismatic"
    if kind != int(mujoco.mjtJoint.mjJNT_HINGE) or model.jnt_pos[j].any():
        raise InputError(f"joint {model.joint(j).name!r} is no hinge through its body's origin, and no slide")
    return "revolute" if limited else "continuous"
