"""Differences and sums of MuJoCo states in tangent space, over arrays with any leading batch shape.

A configuration holds unit quaternions (free and ball joints), whose differences live in three numbers: the rotation
vector in the body's own frame, as `mj_differentiatePos` and `mj_integratePos` have it.
"""

from collections.abc import Sequence
from math import sqrt
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def components(array: Array) -> Any:
    """Components (...) of vectors (..., k), to be unpacked: floats for one vector, as their arithmetic is fastest.

    Float and array arithmetic round alike, so that one vector and a row of many agree to the bit. Beware that floats
    raise where arrays give infinity (division by zero), and that `x ** 2` rounds differently for the two: `x * x`.
    """
    if array.ndim == 1:
        return array.tolist()
    return [array[..., i] for i in range(array.shape[-1])]


def joined(parts: Sequence[Any]) -> Array:
    """Vectors (..., k) of k components (...)."""
    if isinstance(parts[0], float):
        return np.array(parts)
    out = np.empty((*parts[0].shape, len(parts)))
    for i, part in enumerate(parts):
        out[..., i] = part
    return out


def root(x: Any) -> Any:
    """Square root of a float or of arrays: rounded correctly by both libraries, so the same to the bit."""
    return sqrt(x) if isinstance(x, float) else np.sqrt(x)


def quat_multiply(a: Array, b: Array) -> Array:
    """Hamilton product of quaternions (..., 4), scalar first."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def quat_conjugate(q: Array) -> Array:
    """Inverse of unit quaternions (..., 4)."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def quat_to_vector(q: Array) -> Array:
    """Rotation vector (..., 3), rad, of unit quaternions (..., 4): the shorter way round."""
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    return q[..., 1:] * np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1), 2.0)


def vector_to_quat(v: Array) -> Array:
    """Unit quaternions (..., 4) of rotation vectors (..., 3), rad."""
    angle = np.linalg.norm(v, axis=-1, keepdims=True)
    half = np.where(angle > 1e-12, np.sin(angle / 2) / np.where(angle > 1e-12, angle, 1), 0.5)
    return np.concatenate([np.cos(angle / 2), half * v], -1)


def quat_difference(a: Array, b: Array) -> Array:
    """Rotation vector (..., 3) that takes `a` to `b`, in the frame of `a`."""
    return quat_to_vector(quat_multiply(quat_conjugate(a), b))


def cross_parts(a: Sequence[Any], b: Sequence[Any]) -> tuple[Any, Any, Any]:
    """Cross product of vectors, by components (...)."""
    x, y, z = a
    u, v, w = b
    return y * w - z * v, z * u - x * w, x * v - y * u


def rotate_parts(q: Sequence[Any], v: Sequence[Any]) -> tuple[Any, Any, Any]:
    """Vectors rotated by unit quaternions, by components (...)."""
    w, x, y, z = q
    i, j, k = v
    a, b, c = 2 * (y * k - z * j), 2 * (z * i - x * k), 2 * (x * j - y * i)
    return i + w * a + (y * c - z * b), j + w * b + (z * a - x * c), k + w * c + (x * b - y * a)


def rotate_back_parts(q: Sequence[Any], v: Sequence[Any]) -> tuple[Any, Any, Any]:
    """Vectors rotated by the inverse of unit quaternions, by components (...): world to body."""
    w, x, y, z = q
    return rotate_parts((w, -x, -y, -z), v)


def cross(a: Array, b: Array) -> Array:
    """Cross product of vectors (..., 3); `np.cross` gives the same bits, on small arrays in ten times the time."""
    return joined(cross_parts(components(a), components(b)))


def rotate(q: Array, v: Array) -> Array:
    """Vectors (..., 3) rotated by unit quaternions (..., 4)."""
    return joined(rotate_parts(components(q), components(v)))


def rotate_back(q: Array, v: Array) -> Array:
    """Vectors (..., 3) rotated by the inverse of unit quaternions (..., 4): world to body."""
    return joined(rotate_back_parts(components(q), components(v)))


def yaw(q: Array) -> Array:
    """Heading (...,), rad, of unit quaternions (..., 4): of the body's x axis in the horizontal plane."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _blocks(model: mujoco.MjModel) -> tuple[NDArray[np.intp], NDArray[np.intp], list[tuple[int, int]]]:
    """(coordinates, dofs) that subtract plainly, and (quaternion address, dof address) of the rotations."""
    plain_q: list[int] = []
    plain_v: list[int] = []
    rotations: list[tuple[int, int]] = []
    for kind, q, v in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        if int(kind) == int(mujoco.mjtJoint.mjJNT_FREE):
            plain_q += [q, q + 1, q + 2]
            plain_v += [v, v + 1, v + 2]
            rotations.append((int(q) + 3, int(v) + 3))
        elif int(kind) == int(mujoco.mjtJoint.mjJNT_BALL):
            rotations.append((int(q), int(v)))
        else:
            plain_q.append(int(q))
            plain_v.append(int(v))
    return np.array(plain_q, np.intp), np.array(plain_v, np.intp), rotations


class Tangent:
    """Differences and sums of a model's configurations, with its joints sorted once."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.nq, self.nv = int(model.nq), int(model.nv)
        self.plain_q, self.plain_v, self.rotations = _blocks(model)

    def difference(self, start: Array, end: Array) -> Array:
        """Tangent vector (..., nv) that takes configuration `start` (..., nq) to `end` (..., nq) in unit time."""
        shape = np.broadcast_shapes(start.shape[:-1], end.shape[:-1])
        out = np.zeros((*shape, self.nv))
        out[..., self.plain_v] = end[..., self.plain_q] - start[..., self.plain_q]
        for q, v in self.rotations:
            out[..., v : v + 3] = quat_difference(start[..., q : q + 4], end[..., q : q + 4])
        return out

    def integrate(self, start: Array, step: Array) -> Array:
        """Configuration (..., nq) reached from `start` (..., nq) by the tangent vector `step` (..., nv)."""
        shape = np.broadcast_shapes(start.shape[:-1], step.shape[:-1])
        out = np.broadcast_to(start, (*shape, self.nq)).copy()
        out[..., self.plain_q] += step[..., self.plain_v]
        for q, v in self.rotations:
            out[..., q : q + 4] = quat_multiply(out[..., q : q + 4], vector_to_quat(step[..., v : v + 3]))
        return out


def difference(model: mujoco.MjModel, start: Array, end: Array) -> Array:
    """`Tangent.difference` for a model seen once."""
    return Tangent(model).difference(start, end)


def integrate(model: mujoco.MjModel, start: Array, step: Array) -> Array:
    """`Tangent.integrate` for a model seen once."""
    return Tangent(model).integrate(start, step)


def move(model: mujoco.MjModel, qpos: Array, step: Array) -> None:
    """Configurations (nq,) or (n, nq) moved in place by tangent vectors of their shape, by MuJoCo itself.

    One configuration costs a hundredth of what `integrate` takes; results agree to rounding.
    """
    for q, v in zip(qpos, step, strict=True) if qpos.ndim > 1 else ((qpos, step),):
        mujoco.mj_integratePos(model, q, v, 1.0)


class Inertia:
    """The joint-space inertia matrix times a velocity, row by row and by MuJoCo itself: a microsecond each."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.aside = model, mujoco.MjData(model)
        self.packed = self.aside.M

    def times(self, packed: Array, velocity: Array) -> Array:
        """Momentum M v, (nv,) or (n, nv), from `MjData.M`, (nC,) or (n, nC), and velocities of the result's shape."""
        out = np.empty(velocity.shape)
        if velocity.ndim == 1:
            self._into(out, packed, velocity)
            return out
        for row in zip(out, packed, velocity, strict=True):
            self._into(*row)
        return out

    def _into(self, out: Array, packed: Array, velocity: Array) -> None:
        self.packed[...] = packed
        mujoco.mj_mulM(self.model, self.aside, out, velocity)
