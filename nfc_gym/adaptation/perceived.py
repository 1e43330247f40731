"""The ground of a trajectory, put together from the elevation maps that the robot perceived along it.

A map is a bilinear look-up in the ground around where the base was. The ground of the least squared error over all maps
undoes that smoothing, where averaging maps that were turned back would add to it; places that a map shows near the base
count for more, and what is known badly stays near the average. What was never seen is as high as the nearest place
that was.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import lsqr

from nfc_gym.adaptation.trajectory import Trajectory
from nfc_gym.core.errors import InputError
from nfc_gym.envs.rotations import yaw
from nfc_gym.terrain import Heightfield
from nfc_gym.terrain.egocentric import CELL, SIZE, to_grid
from nfc_gym.terrain.heightfield import RESOLUTION, SHAPE

Array = NDArray[np.float64]
_NEAR = 3.0  # m: a cell this far from the base counts for 1 / e of one below it
_LEAST = 1e-3  # of the weight of what is far away
_DAMPED = 0.1  # pull to the average, in units of one cell seen from near
_STEPS = 30  # of least squares; by then heights change by less than 0.1 mm


def perceived_ground(trajectory: Trajectory) -> tuple[Heightfield, float]:
    """The ground that a trajectory's maps show, on the grid of the environments' maps, as far as it was seen.

    Args:
      trajectory: with maps, and a state estimate that begins with a free base's position and quaternion.

    Returns:
      The ground, and how far maps are off it near the base, m: what their noise is at least, since an error that all of
      them share does not show.

    Raises:
      InputError: it holds no maps, or does not say where the base was.
    """
    if not len(trajectory.maps):
        raise InputError(
            "the trajectory holds no elevation maps: make the world with context=['psi', 'elevation'], or say what the "
            "ground is (`ground=`)"
        )
    if trajectory.estimate.shape[1] < 7:
        raise InputError(
            "the trajectory holds elevation maps, and no state estimate that says where the base was when they were "
            "perceived: its `estimate` must begin with the base's position and quaternion"
        )
    look, seen, weight = _looks(trajectory.estimate[trajectory.looks], trajectory.maps)
    counted = weight @ look
    known = counted > 1e-9
    average = np.where(known, (weight * seen) @ look / np.maximum(counted, 1e-9), 0.0).reshape(SHAPE)
    nearest: tuple = distance_transform_edt(~known.reshape(SHAPE), return_distances=False, return_indices=True)  # type: ignore[assignment]
    first = average[tuple(nearest)].reshape(-1)
    root = np.sqrt(weight)
    heights = lsqr(diags_array(root) @ look, root * seen, damp=_DAMPED, iter_lim=_STEPS, x0=first)[0]
    off = look @ heights - seen
    return Heightfield(heights.reshape(SHAPE), RESOLUTION), float(np.sqrt(weight @ off**2 / weight.sum()))


def _looks(base: Array, maps: NDArray) -> tuple[csr_array, Array, Array]:
    """Every cell of every map as a look-up in the ground.

    Args:
      base: (k, 7 or more) positions and quaternions of the base.
      maps: (k, 128, 128) heights over the base.

    Returns:
      (m, cells of the ground) weights of the four corners around each, (m,) heights, (m,) how much each counts.
    """
    origin, (rows, columns) = Heightfield(np.zeros(SHAPE)).origin, SHAPE
    i, j = (a.reshape(-1) for a in np.indices((SIZE, SIZE)))
    away = (CELL * (i - (SIZE - 1) / 2)) ** 2 + (CELL * (j - (SIZE - 1) / 2)) ** 2
    near = np.exp(-away / _NEAR**2) + _LEAST
    at, share, seen, weight = [], [], [], []
    for pose, heights in zip(base, maps, strict=True):
        turn = to_grid((pose[:2] - origin) / RESOLUTION, yaw(pose[3:7]), CELL / RESOLUTION)
        x, y = turn @ np.stack([j, i, np.ones_like(i)])
        inside = (x >= 0) & (x < columns - 1) & (y >= 0) & (y < rows - 1)  # a map repeats the edge beyond it
        x, y = x[inside], y[inside]
        column, row = x.astype(np.intp), y.astype(np.intp)
        u, v = x - column, y - row
        at.append(np.stack([row * columns + column + k for k in (0, 1, columns, columns + 1)], 1))
        share.append(np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], 1))
        seen.append(heights.reshape(-1)[inside] + pose[2])
        weight.append(near[inside])
    where, shares = np.concatenate(at), np.concatenate(share)
    starts = np.arange(0, shares.size + 1, 4)
    look = csr_array((shares.reshape(-1), where.reshape(-1), starts), (len(shares), rows * columns))
    return look, np.concatenate(seen), np.concatenate(weight)
