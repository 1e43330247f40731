"""Ego-centric elevation maps: terrain heights around a robot, turned with its heading, relative to its base.

`elevation[i, j]` is the terrain's height minus the base's at x = (i - 63.5) 0.1 m forward and y = (j - 63.5) 0.1 m left
of the base. Between grid points it is bilinear (what a mapping node that resamples its grid gives), which differs from
the collision surface of `Heightfield.height` by at most a quarter of a cell's twist. Beyond the edge it repeats that.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import real_array
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
    base, heading = _checked(xyz, yaw)
    if out is None:
        out = np.empty((*heading.shape, SIZE, SIZE), np.float32)
    elif out.shape != (*heading.shape, SIZE, SIZE) or out.dtype != np.float32 or not out.flags.c_contiguous:
        raise InputError(f"out is {out.dtype} {out.shape}; want float32 {(*heading.shape, SIZE, SIZE)}, contiguous")
    _look(heightfield, base, heading, np.eye(3), out.reshape(heading.size, SIZE, SIZE))
    return out


@dataclass(frozen=True)
class Cells:
    """Some cells of an elevation map: `elevation[..., i, j]` on a coarser, smaller grid.

    Attributes:
      first: row and column of the first.
      step: cells from one to the next, either way.
      shape: how many of them, forward and to the left.

    Raises:
      InputError: the grid reaches outside the map.
    """

    first: tuple[int, int]
    step: int
    shape: tuple[int, int]

    def __post_init__(self) -> None:
        for at, count in zip(self.first, self.shape, strict=True):
            if at < 0 or self.step < 1 or count < 1 or at + self.step * (count - 1) >= SIZE:
                raise InputError(f"{self} reaches outside the {SIZE} x {SIZE} elevation map")

    def of(self, elevation: NDArray) -> NDArray:
        """These cells (..., *shape) of whole maps (..., SIZE, SIZE)."""
        rows, columns = (slice(a, a + self.step * n, self.step) for a, n in zip(self.first, self.shape, strict=True))
        return elevation[..., rows, columns]

    def around(
        self, heightfield: Heightfield | Sequence[Heightfield], xyz: ArrayLike, yaw: ArrayLike
    ) -> NDArray[np.float32]:
        """The same cells (..., *shape) without the rest of the maps; arguments and errors as of `elevation`."""
        base, heading = _checked(xyz, yaw)
        out = np.empty((*heading.shape, *self.shape), np.float32)
        coarser = np.array([[self.step, 0, self.first[1]], [0, self.step, self.first[0]], [0, 0, 1]], float)
        _look(heightfield, base, heading, coarser, out.reshape(heading.size, *self.shape))
        return out


def _checked(xyz: ArrayLike, yaw: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions (..., 3) and headings (...)."""
    base, heading = real_array(xyz), real_array(yaw)
    if base is None or heading is None:
        raise InputError(f"xyz is {xyz!r} and yaw {yaw!r}; want arrays of numbers")
    if base.shape != (*heading.shape, 3):
        raise InputError(f"xyz has shape {base.shape} and yaw {heading.shape}; want (..., 3) and (...)")
    if not (np.isfinite(base).all() and np.isfinite(heading).all()):
        raise InputError("xyz and yaw must be finite")
    return base, heading


def _look(
    heightfield: Heightfield | Sequence[Heightfield], base: NDArray, heading: NDArray, grid: NDArray, out: NDArray
) -> None:
    """Write maps (count, rows, columns), whose cells `grid` (3, 3) takes to (j, i) of the elevation map."""
    count = heading.size
    if not isinstance(heightfield, Heightfield | Iterable):
        raise InputError(f"heightfield is {heightfield!r}; want a Heightfield, or a sequence of them")
    fields = [heightfield] * count if isinstance(heightfield, Heightfield) else list(heightfield)
    if len(fields) != count:
        raise InputError(f"{len(fields)} heightfields for {count} robots; want one for all or one each")
    places, turns = base.reshape(-1, 3), heading.reshape(-1)
    if isinstance(heightfield, Heightfield):  # numbers rather than arrays of equal ones
        resolution, origin = heightfield.resolution, np.array(heightfield.origin)
    else:
        resolution, origin = np.array([[f.resolution] for f in fields]), np.array([f.origin for f in fields])
    centre = (places[:, :2] - origin.reshape(-1, 2)) / resolution
    matrices = to_grid(centre, turns, CELL / np.reshape(resolution, -1)) @ grid
    lifts, size = places[:, 2].astype(np.float32), (out.shape[2], out.shape[1])
    # Robots on the same map one after the other, so that its heights are still in the cache.
    for k in sorted(range(count), key=lambda k: id(fields[k])):
        cv2.warpAffine(fields[k].heights, matrices[k], size, out[k], _FLAGS, borderMode=cv2.BORDER_REPLICATE)
        np.subtract(out[k], lifts[k], out=out[k])  # while the map is in the cache, too


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
