"""Where a robot starts: turned by a heading, over a spot, as low as the ground below its underside lets it."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.envs.robot import Array, Ground
from nfc_gym.envs.rotations import turned

STEP = 0.05  # m between sampled points: half a cell of the maps
_AROUND = 2 * np.pi * np.arange(8) / 8
_RIM = np.vstack([[0.0, 0.0], np.column_stack([np.cos(_AROUND), np.sin(_AROUND)])])


def underside(model: mujoco.MjModel, qpos: Array) -> Array:
    """Points (m, 3) below which a robot's colliding geoms do not reach, relative to its root, in a pose (nq,).

    Capsules and spheres are sampled along their axis and round it, boxes throughout; the height at a point is that of
    the lowest point of the sampled piece, so that nothing is missed between points.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    pieces = []
    for geom in np.flatnonzero((model.geom_conaffinity > 0) & (model.geom_bodyid > 0)):
        centre, turn, size = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
        kind = int(model.geom_type[geom])
        if kind == int(mujoco.mjtGeom.mjGEOM_BOX):
            grids = [np.linspace(-s, s, 1 + int(np.ceil(2 * s / STEP))) for s in size]
            inside = np.stack(np.meshgrid(*grids, indexing="ij"), -1).reshape(-1, 3)
            pieces.append(centre + inside @ turn.T - [0, 0, STEP / 2])
            continue
        half = size[1] if kind == int(mujoco.mjtGeom.mjGEOM_CAPSULE) else 0.0
        along = np.linspace(-half, half, 1 + int(np.ceil(2 * half / STEP)))
        radius = model.geom_rbound[geom] - half
        axis = centre + along[:, None] * turn[:, 2]
        rim = np.column_stack([_RIM * radius, np.full(len(_RIM), -radius)])
        pieces.append((axis[:, None] + rim).reshape(-1, 3))
    return np.concatenate(pieces) - qpos[:3]


def place(home: Array, below: Array, x: Array, y: Array, heading: Array, ground: Ground, gap: float) -> Array:
    """Poses (*B, nq): `home` turned by `heading` [rad] over (x, y) [m], `gap` [m] above the ground at its closest.

    Args:
      home: (nq,).
      below: (m, 3) from `underside`.
      x, y, heading: (*B,).
      ground: world points (*B, m, 2) -> heights (*B, m).
      gap: room for what the pose is changed by afterwards.
    """
    cos, sin = np.cos(heading)[..., None], np.sin(heading)[..., None]
    px = x[..., None] + cos * below[:, 0] - sin * below[:, 1]
    py = y[..., None] + sin * below[:, 0] + cos * below[:, 1]
    qpos = np.empty((*np.shape(x), len(home)))
    qpos[...] = home
    qpos[..., 0], qpos[..., 1] = x, y
    qpos[..., 2] = (ground(np.stack((px, py), -1)) - below[:, 2]).max(-1) + gap
    qpos[..., 3:7] = turned(home[3:7], heading)
    return qpos


def spread(u: NDArray, low: float, high: float) -> NDArray:
    """Uniform numbers in [0, 1) to [low, high)."""
    return low + (high - low) * u
