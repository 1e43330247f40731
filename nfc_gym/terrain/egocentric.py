"""Ego-centric elevation maps: terrain heights around a robot, turned with its heading, relative to its base.

`elevation[i, j]` is the terrain's height minus the base's at x = (i - 63.5) 0.1 m forward and y = (j - 63.5) 0.1 m left
of the base. Between grid points it is bilinear (what a mapping node that resamples its grid gives), which differs from
the collision surface of `Heightfield.height` by at most a quarter of a cell's twist. Beyond the edge it repeats that.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.terrain.heightfield import Heightfield

SIZE = 128  # cells a side
CELL = 0.1  # m a cell

_FLAGS = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP


def elevation(
    heightfield: Heightfield | Sequence[Heightfield],
    xyz: ArrayLike,
    yaw: ArrayLike,
    *,
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Elevation maps around robots.

    Args:
      heightfield: one map for all, or a sequence with one for each robot.
      xyz: (..., 3) base positions in the world [m].
      yaw: (...) headings [rad].
      out: (..., SIZE, SIZE) float32 to write into; by default a fresh array.

    Returns:
      (..., SIZE, SIZE) float32 [m].

    Raises:
      InputError: shapes that do not fit each other, or positions or headings that are not finite.
    """
    base, heading = np.asarray(xyz, np.float64), np.asarray(yaw, np.float64)
    if base.shape != (*heading.shape, 3):
        raise InputError(f"xyz has shape {base.shape} and yaw {heading.shape}; want (..., 3) and (...)")
    if not (np.isfinite(base).all() and np.isfinite(heading).all()):
        raise InputError("xyz and yaw must be finite")
    if out is None:
        out = np.empty((*heading.shape, SIZE, SIZE), np.float32)
    elif out.shape != (*heading.shape, SIZE, SIZE) or out.dtype != np.float32 or not out.flags.c_contiguous:
        raise InputError(f"out is {out.dtype} {out.shape}; want float32 {(*heading.shape, SIZE, SIZE)}, contiguous")
    count = heading.size
    fields = [heightfield] * count if isinstance(heightfield, Heightfield) else list(heightfield)
    if len(fields) != count:
        raise InputError(f"{len(fields)} heightfields for {count} robots; want one for all or one each")
    places, turns = base.reshape(-1, 3), heading.reshape(-1)
    if isinstance(heightfield, Heightfield):  # numbers rather than arrays of equal ones
        resolution, origin = heightfield.resolution, np.array(heightfield.origin)
    else:
        resolution, origin = np.array([[f.resolution] for f in fields]), np.array([f.origin for f in fields])
    centre = (places[:, :2] - origin.reshape(-1, 2)) / resolution
    matrices = to_grid(centre, turns, CELL / np.reshape(resolution, -1))
    lifts, maps = places[:, 2].astype(np.float32), out.reshape(count, SIZE, SIZE)
    # Robots on the same map one after the other, so that its heights are still in the cache.
    for k in sorted(range(count), key=lambda k: id(fields[k])):
        cv2.warpAffine(fields[k].heights, matrices[k], (SIZE, SIZE), maps[k], _FLAGS, borderMode=cv2.BORDER_REPLICATE)
        np.subtract(maps[k], lifts[k], out=maps[k])  # while the map is in the cache, too
    return out


def to_grid(
    centre: NDArray[np.float64], yaw: NDArray[np.float64], ratio: float | NDArray[np.float64] = 1.0
) -> NDArray[np.float64]:
    """Affine maps from (j, i) of the elevation map to (column, row) of a grid.

    Args:
      centre: (..., 2) column and row below the base.
      yaw: (...) headings [rad].
      ratio: (...) size of the elevation map's cells over that of the grid's.

    Returns:
      (..., 2, 3).
    """
    cos, sin, middle = ratio * np.cos(yaw), ratio * np.sin(yaw), (SIZE - 1) / 2
    matrix = np.empty((*np.shape(yaw), 2, 3))
    # world = base + forward (cos, sin) + left (-sin, cos), with forward along i and left along j
    matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 0, 2] = -sin, cos, centre[..., 0] + middle * (sin - cos)
    matrix[..., 1, 0], matrix[..., 1, 1], matrix[..., 1, 2] = cos, sin, centre[..., 1] - middle * (cos + sin)
    return matrix
