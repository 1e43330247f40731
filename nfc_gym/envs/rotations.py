"""Rotations by components: unit quaternions (w, x, y, z), any leading batch shape () or (n,).

Written out in multiplications and additions, without matrix products: those round differently for one robot and for
many, and one robot must give the same bits as a row of a batch.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nfc_gym.physics.state import components

Array = NDArray[np.float64]


def some(flags: Any) -> Any:
    """Whether a flag, or any of an array of them, is set."""
    return flags if isinstance(flags, bool) else np.count_nonzero(flags)


def at_most(x: Any, bound: float) -> Any:
    """A float or array, or the bound where that is smaller."""
    return min(x, bound) if isinstance(x, float) else np.minimum(x, bound)


def at_least(x: Any, bound: float) -> Any:
    """A float or array, or the bound where that is larger."""
    return max(x, bound) if isinstance(x, float) else np.maximum(x, bound)


class Axes(NamedTuple):
    """Rows of the rotation matrix that takes the robot's frame to the world: world x, y, z of forward, left and up."""

    xx: Array
    xy: Array
    xz: Array
    yx: Array
    yy: Array
    yz: Array
    zx: Array
    zy: Array
    zz: Array


def axes(quat: Array) -> Axes:
    """Rotation matrix of quaternions (..., 4), by entries (...): `xy` is the world x of the robot's y axis."""
    w, x, y, z = components(quat)
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz = x * y, x * z, y * z
    wx, wy, wz = w * x, w * y, w * z
    return Axes(
        1 - 2 * (yy + zz),
        2 * (xy - wz),
        2 * (xz + wy),
        2 * (xy + wz),
        1 - 2 * (xx + zz),
        2 * (yz - wx),
        2 * (xz - wy),
        2 * (yz + wx),
        1 - 2 * (xx + yy),
    )


def in_robot(r: Axes, vector: Array) -> tuple[Array, Array, Array]:
    """Components (...) along the robot's axes of world vectors (..., 3)."""
    x, y, z = components(vector)
    return r.xx * x + r.yx * y + r.zx * z, r.xy * x + r.yy * y + r.zy * z, r.xz * x + r.yz * y + r.zz * z


def to_robot(r: Axes, vector: Array) -> Array:
    """World vectors (..., 3) in the robot's frame, (..., 3)."""
    return np.array(in_robot(r, vector)).T


def to_world(r: Axes, vector: Array) -> Array:
    """The robot's vectors (..., 3) in the world's frame, (..., 3)."""
    x, y, z = components(vector)
    return np.array((r.xx * x + r.xy * y + r.xz * z, r.yx * x + r.yy * y + r.yz * z, r.zx * x + r.zy * y + r.zz * z)).T


def yaw(quat: Array) -> Array:
    """Heading (...) of quaternions (..., 4): the angle of the forward axis in the world's plane [rad]."""
    w, x, y, z = components(quat)
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def planar(qpos: Array) -> Array:
    """x and y [m] and heading [rad] (..., 3) of positions (..., nq) with the base's place and quaternion first."""
    return np.concatenate([qpos[..., :2], yaw(qpos[..., 3:7])[..., None]], -1)


def turned(quat: Array, heading: Array) -> Array:
    """Quaternion (4,) turned about the world's z axis by headings (...) [rad], (..., 4)."""
    c, s = np.cos(heading / 2), np.sin(heading / 2)
    w, x, y, z = quat
    return np.array((c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w)).T
