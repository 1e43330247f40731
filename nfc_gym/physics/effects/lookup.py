"""Names in a model, the addresses behind them, and the places that names make together."""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.names import names as names_in

Array = NDArray[np.float64]
Rows = slice | NDArray[np.intp]  # what picks rows of an array, see `index`
_BALL = int(mujoco.mjtJoint.mjJNT_BALL)
# Degrees of freedom of the joints that move in one way, and not in two that have no unit in common.
_SIZES = {_BALL: 3, int(mujoco.mjtJoint.mjJNT_SLIDE): 1, int(mujoco.mjtJoint.mjJNT_HINGE): 1}
# Words that tell corners and sides of a machine apart.
_CORNERS = {
    "fl", "fr", "rl", "rr", "lf", "rf", "lh", "rh", "hl", "hr", "bl", "br", "front", "rear", "back", "hind",
    "left", "right", "l", "r",
}  # fmt: skip


def joint_dofs(model: mujoco.MjModel, names: Sequence[str], balls: bool = False) -> NDArray[np.intp]:
    """Dof addresses of named joints, (n,): one of each hinge and slide joint, all three of each ball joint.

    Args:
      balls: whether there may be ball joints. No law has one number for the forces and the torques of a free joint.

    Raises:
      InputError: the model has no such joint, or it is of another type.
    """
    known = ", ".join(scalar_joints(model, balls)) or "none"
    out: list[int] = []
    for name in names:
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
        if joint < 0:
            raise InputError(f"the model has no joint named {name!r}; it has: {known}")
        kind, first = int(model.jnt_type[joint]), int(model.jnt_dofadr[joint])
        if kind not in _SIZES or (kind == _BALL and not balls):
            told = "ball" if kind == _BALL else "free"
            raise InputError(
                f"joint {name!r} is a {told} joint, on which the effect cannot sit; joints for it: {known}"
            )
        out += range(first, first + _SIZES[kind])
    return np.array(out, np.intp)


def index(rows: NDArray[np.intp]) -> Rows:
    """Rows (n,) as what picks them fastest: a slice where they are evenly spaced, of which numpy makes no copy."""
    step = int(rows[1] - rows[0]) if len(rows) > 1 else 1
    if step < 1 or (np.diff(rows) != step).any():
        return rows
    return slice(int(rows[0]), int(rows[-1]) + 1, step)


def limited(x: Array, low: Array | float, high: Array | float) -> Array:
    """`np.clip`, on small arrays in a third of the time."""
    return np.minimum(np.maximum(x, low), high)


def scalar_joints(model: mujoco.MjModel, balls: bool = False) -> list[str]:
    """Names of the hinge and slide joints, and with `balls` of the ball joints."""
    names = (mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, j) for j in range(model.njnt))
    kinds = [kind for kind in _SIZES if balls or kind != _BALL]
    return [name for name, kind in zip(names, model.jnt_type, strict=True) if name and int(kind) in kinds]


def actuator_names(model: mujoco.MjModel) -> list[str]:
    """What actuators are called, in id order: an unnamed one as the joint that it moves, as in logs of its model."""
    return names_in(model).actuators


def one_command_each(model: mujoco.MjModel) -> bool:
    """Whether each actuator has one command and one force, so that its id is the column of both."""
    return model.nu == model.nactuator == model.nout


def actuator_ids(model: mujoco.MjModel, names: Sequence[str]) -> NDArray[np.intp]:
    """Id of each actuator, (n,), as `actuator_names` calls them.

    Raises:
      InputError: the model has no such actuator, or some with several commands or forces (`orientation`, `pid`).
    """
    known = actuator_names(model)
    if names and not one_command_each(model):
        wide = [
            n for n, c, f in zip(known, model.actuator_ctrlnum, model.actuator_outnum, strict=True) if c > 1 or f > 1
        ]
        raise InputError(
            f"effects on actuators want one command and one force of each, and {', '.join(wide)} of this model has more"
        )
    for name in names:
        if name not in known:
            raise InputError(f"the model has no actuator named {name!r}; it has: {', '.join(known)}")
    return np.array([known.index(n) for n in names], np.intp)


def groups(names: Sequence[str]) -> list[tuple[str, ...]]:
    """Places made of `names`: each alone, all together, and sets that share a kind (`fl_hip`, `fr_hip`, ... -> hips).

    Names are read as words; the words that tell corners and sides apart (fl, rear, left, 1) are set aside, and names
    that agree in the rest form a set.
    """
    sets: dict[str, list[str]] = {}
    for name in names:
        words = [w for w in name.lower().replace("-", "_").split("_") if w not in _CORNERS and not w.isdigit()]
        sets.setdefault("_".join(words), []).append(name)
    out: list[tuple[str, ...]] = [(n,) for n in names]
    if len(names) > 1:
        out.append(tuple(names))
    out += [tuple(s) for s in sets.values() if 1 < len(s) < len(names)]
    return out
