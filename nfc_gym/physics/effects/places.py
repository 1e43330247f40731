"""Where effects can sit in a model, and sizes that fit it: helpers that the families share."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import reduce

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Array, Scales
from nfc_gym.physics.effects.lookup import groups, joint_dofs
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.fields import ModelFields, names_of

_SLIDE, _HINGE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
_LIGHT = 1e-3  # share of mass below which a body only carries another


def sized(params: Iterable[Param], **changes: dict[str, object]) -> tuple[Param, ...]:
    """The same parameters with some attributes replaced, by parameter name."""
    return tuple(replace(p, **changes.get(p.name, {})) for p in params)


def with_units(params: Iterable[Param], units: dict[str, str]) -> tuple[Param, ...]:
    """The same parameters with other units, by parameter name."""
    return tuple(replace(p, unit=units.get(p.name, p.unit)) for p in params)


def joint_kind(model: mujoco.MjModel, name: str) -> int:
    """`mjtJoint` of a named joint."""
    return int(model.jnt_type[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)])


def joint_places(model: mujoco.MjModel) -> list[tuple[str, ...]]:
    """Named hinge joints and named slide joints: each alone, all of a kind together, and sets of like names.

    Hinges and slides never share a place, because their forces have different units. The joints that let a planar base
    float over the world are no bearings and are left out.
    """
    floating = _floating(model)
    names = names_of(model, mujoco.mjtObj.mjOBJ_JOINT, model.njnt)
    out: list[tuple[str, ...]] = []
    for kind in (_HINGE, _SLIDE):
        alike = [n for j, n in enumerate(names) if n and int(model.jnt_type[j]) == kind and j not in floating]
        out += groups(alike) if alike else []
    return out


def _carriers(model: mujoco.MjModel, body: int) -> tuple[list[int], bool]:
    """Joints of a body and of the (nearly) massless bodies that carry it, and whether those stand on the world."""
    joints: list[int] = []
    b = body
    while b > 0 and (b == body or model.body_mass[b] < _LIGHT * model.body_mass[body]):
        first = int(model.body_jntadr[b])
        joints += range(first, first + int(model.body_jntnum[b]))
        b = int(model.body_parentid[b])
    return joints, int(model.body_weldid[b]) == 0


def _floating(model: mujoco.MjModel) -> set[int]:
    """Undriven joints of bases that slide freely over the world along two axes or more, the turning ones included."""
    joint = int(mujoco.mjtTrn.mjTRN_JOINT)
    driven = {
        int(model.actuator_trnid[i, 0]) for i in range(model.nactuator) if int(model.actuator_trntype[i]) == joint
    }
    out: set[int] = set()
    for body in range(1, model.nbody):
        joints, grounded = _carriers(model, body)
        slides = sum(int(model.jnt_type[j]) == _SLIDE for j in joints)
        if grounded and slides > 1 and not driven & set(joints):
            out |= set(joints)
    return out


def turns(model: mujoco.MjModel, dof: int) -> bool:
    """Whether a degree of freedom is an angle: of a hinge or a ball joint, or of a free joint's rotation."""
    joint = int(model.dof_jntid[dof])
    kind = int(model.jnt_type[joint])
    return kind in (_HINGE, _BALL) or (kind == _FREE and dof - int(model.jnt_dofadr[joint]) >= 3)


def with_joint_units(params: Iterable[Param], model: mujoco.MjModel, dofs: Iterable[int]) -> tuple[Param, ...]:
    """The same parameters with units that fit what they act on: families declare those of a hinge."""
    if any(turns(model, int(d)) for d in dofs):
        return tuple(params)
    return tuple(replace(p, unit=slid(p.unit)) for p in params)


def slid(unit: str) -> str:
    """What takes the place of a hinge's unit where a joint slides."""
    pairs = (("kg m^2", "kg"), ("N m", "N"), ("rad", "m"))
    return reduce(lambda told, pair: told.replace(*pair), pairs, unit)


def force_unit(model: mujoco.MjModel, joint: str) -> str:
    """`N m` for a hinge, `N` for a slide."""
    return "N m" if joint_kind(model, joint) == _HINGE else "N"


def angle_unit(model: mujoco.MjModel, joint: str) -> str:
    """`rad` for a hinge, `m` for a slide."""
    return "rad" if joint_kind(model, joint) == _HINGE else "m"


def typical(values: NDArray, rows: NDArray[np.intp], floor: float = 1e-3) -> float:
    """Median of a scale over some rows, kept off zero so that bounds and sizes made of it are usable."""
    return max(float(np.median(np.abs(np.asarray(values, float)[rows]))), floor)


def joint_scales(model: mujoco.MjModel, scales: Scales, names: Sequence[str]) -> tuple[float, float]:
    """(force, speed) typical of the named scalar joints."""
    dofs = joint_dofs(model, names)
    return typical(scales.force, dofs), typical(scales.speed, dofs, 1e-2)


def largest_push(model: mujoco.MjModel, scales: Scales, names: Sequence[str]) -> float:
    """Force of the actuators that the named joints are known to have seen, each at most; their median, 0 if unknown."""
    return 0.0 if scales.push is None else float(np.median(scales.push[joint_dofs(model, names)]))


def moving_bodies(model: mujoco.MjModel) -> list[str]:
    """Names of bodies that have mass and can move, one for each set of bodies welded together."""
    names, moves = names_of(model, mujoco.mjtObj.mjOBJ_BODY, model.nbody), _moves(model)
    return [
        names[b]
        for b in range(1, model.nbody)
        if names[b] and moves[b] and int(model.body_weldid[b]) == b and model.body_mass[b] > 0
    ]


def _moves(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """(nbody,) whether forces move a body: it or one that carries it has a joint. A mocap goes where it is put."""
    out = np.array(model.body_jntnum) > 0
    for body in range(1, model.nbody):  # parents come first
        out[body] |= out[model.body_parentid[body]]
    return out


def base_bodies(model: mujoco.MjModel) -> list[str]:
    """Bodies that move through the world by themselves: free bases, and bases on slides that stand on the world."""
    names = names_of(model, mujoco.mjtObj.mjOBJ_BODY, model.nbody)
    moving, out = set(moving_bodies(model)), []
    for body in range(1, model.nbody):
        joints, grounded = _carriers(model, body)
        kinds = {int(model.jnt_type[j]) for j in joints}
        light = model.body_mass[body] < _LIGHT * model.body_subtreemass[body]
        if names[body] in moving and not light and (_FREE in kinds or (grounded and _SLIDE in kinds)):
            out.append(names[body])
    return out


def end_bodies(model: mujoco.MjModel) -> list[str]:
    """Moving bodies that carry no other moving body: the tips of an arm, the load of a crane."""
    moving = moving_bodies(model)
    ids = body_ids(model, moving)
    parents = {int(model.body_weldid[model.body_parentid[b]]) for b in ids}
    return [n for n, b in zip(moving, ids, strict=True) if int(b) not in parents]


def exposed_bodies(model: mujoco.MjModel, arms: bool = False) -> list[str]:
    """Bodies that air and pushes act on: bases, and the ends of what rides on a base that its rails keep from turning.

    A push on a crane's load is none on its trolley, while one on a robot's foot is nearly one on its trunk.

    Args:
      arms: the ends of what no base carries, too.
    """
    bases = base_bodies(model)
    ids = set(body_ids(model, bases).tolist())
    rails = {b for b in ids if all(int(model.jnt_type[j]) == _SLIDE for j in _carriers(model, b)[0])}
    out, ends = list(bases), [n for n in end_bodies(model) if n not in bases]
    for name, body in zip(ends, body_ids(model, ends).tolist(), strict=True):
        below = _below(model, body)
        if below & rails or (arms and not below & ids):
            out.append(name)
    return out


def _below(model: mujoco.MjModel, body: int) -> set[int]:
    """Bodies that carry a body, down to the world."""
    out: set[int] = set()
    while body > 0:
        body = int(model.body_parentid[body])
        out.add(body)
    return out


def body_ids(model: mujoco.MjModel, names: Sequence[str]) -> NDArray[np.intp]:
    """Id of each named body, (n,).

    Raises:
      InputError: a name that the model lacks, or a body that no force moves: the world, what is welded to it, a mocap.
    """
    known, moves = names_of(model, mujoco.mjtObj.mjOBJ_BODY, model.nbody), _moves(model)
    for name in names:
        if name not in known or not moves[known.index(name)]:
            told = f"body {name!r} does not move" if name in known else f"the model has no body named {name!r}"
            told = "the world does not move" if name == known[0] else told
            movable = ", ".join(n for n, free in zip(known, moves, strict=True) if n and free)
            raise InputError(f"{told}; bodies: {movable or 'none'}")
    return np.array([known.index(n) for n in names], np.intp)


def gyration(model: mujoco.MjModel, body: int) -> float:
    """Largest radius of gyration of a body, m: a measure of its extent that needs no geometry."""
    return float(np.sqrt(max(model.body_inertia[body].max(), 1e-12) / max(model.body_mass[body], 1e-12)))


def scale_rows(fields: ModelFields, name: str, rows: NDArray[np.intp], factor: Array) -> None:
    """Multiply rows of a model field by `factor` (...,), in place."""
    array = fields[name]
    wide = factor.reshape(factor.shape + (1,) * (array.ndim - factor.ndim))
    array[..., rows, :] *= wide
