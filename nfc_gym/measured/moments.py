"""Principal moments of inertia that MuJoCo takes: of any body that exists, two together are no less than the third."""

from itertools import combinations

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.physics.state import rotate_back

Array = NDArray[np.float64]
_SIDES = np.array([[-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, -1.0]])  # each times the moments is 0 or more
_ROUNDED = 4e-6  # share of a moment that MJCF text, of six digits, may lose of each of the three
_PARALLEL = 1e-6
_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)


def physical(moments: Array, seen: Array | None = None) -> Array:
    """The nearest moments (3,) that a body can have.

    Args:
      moments: kg m^2, about the principal axes.
      seen: (3,) direction along these axes about which alone the body turns. The moment about it is all that its motion
        shows, and it stays what it is.
    """
    least = _ROUNDED * np.abs(moments).max()
    short = least - _SIDES @ moments
    if (short <= 0).all():
        return moments
    kept = np.zeros((0, 3)) if seen is None else seen[None] ** 2
    # The nearest point lies on some of the planes that bound what is possible: one of the seven sets of them.
    found: list[Array] = [_onto(kept, np.array(sides), short) for n in (1, 2, 3) for sides in combinations(range(3), n)]
    hair = 1e-3 * least
    steps = [s for s in found if (_SIDES @ s >= short - hair).all() and (np.abs(kept @ s) <= hair).all()]
    if not steps:  # what is seen is itself no moment
        return physical(moments)
    return moments + min(steps, key=lambda s: float(s @ s))


def _onto(kept: Array, sides: NDArray[np.intp], short: Array) -> Array:
    """The shortest step (3,) onto some of the planes that leaves what is kept (k, 3) as it is."""
    rows, ends = np.concatenate([kept, _SIDES[sides]]), np.concatenate([np.zeros(len(kept)), short[sides]])
    return np.linalg.lstsq(rows, ends, rcond=None)[0].astype(float)


def only_axis(model: mujoco.MjModel, body: int) -> Array | None:
    """(3,) in the body's frame: the one direction that it turns about, None where it turns about several or none."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    axes, b = [], body
    while b > 0:
        for j in range(int(model.body_jntadr[b]), int(model.body_jntadr[b]) + int(model.body_jntnum[b])):
            if int(model.jnt_type[j]) not in (_HINGE, _SLIDE):
                return None
            if int(model.jnt_type[j]) == _HINGE:
                axes.append(data.xaxis[j])
        b = int(model.body_parentid[b])
    if not axes or any(np.linalg.norm(np.cross(axes[0], a)) > _PARALLEL for a in axes):
        return None
    return rotate_back(data.xquat[body], axes[0])


def mend(spec: mujoco.MjSpec, model: mujoco.MjModel) -> list[str]:
    """Make the explicit inertias of a spec such that it compiles, changed no more than that takes.

    Args:
      spec: with corrected inertias.
      model: the nominal model, with the same bodies and joints.

    Returns:
      A sentence for each body whose moments were changed.
    """
    told = []
    for body in spec.bodies[1:]:  # without the world
        moments = np.asarray(body.inertia, float).copy()
        if not body.explicitinertial or np.isfinite(body.fullinertia[0]) or not moments.any():
            continue
        axis = only_axis(model, int(body.id))
        made = physical(moments, None if axis is None else rotate_back(np.asarray(body.iquat, float), axis))
        if not np.array_equal(made, moments):
            body.inertia = made
            old, new = (", ".join(f"{m:.6g}" for m in values) for values in (moments, made))
            if not np.allclose(made, moments, rtol=10 * _ROUNDED):
                told.append(f"no body can have the moments of inertia ({old}) kg m^2 of {body.name!r}: now ({new})")
    return told
