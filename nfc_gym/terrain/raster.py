"""Triangles seen from above, over the points of a grid: a depth buffer without loops over triangles or points."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TOLERANCE = 1e-3  # cells that a triangle reaches beyond its edge: files hold float32, and no seam may leak
CHUNK = 2_000_000  # pairs of a triangle and a point that are looked at together: bounds the memory at about 200 MB


class Columns(NamedTuple):
    """What lies above and below each point of a grid.

    Attributes:
      top: (nrow, ncol) height of the topmost surface [m]; minus infinity where there is none.
      under: (nrow, ncol) height of the lowest counted surface that the point lies well inside of [m]; plus infinity
        where there is none.
    """

    top: Array
    under: Array


def rasterise(
    vertices: Array,
    faces: NDArray[np.integer],
    shape: tuple[int, int],
    resolution: float,
    origin: tuple[float, float],
    upward_only: bool = False,
) -> Columns:
    """Heights of triangles at the points of a grid.

    Args:
      vertices: (v, 3) [m].
      faces: (f, 3).
      shape, resolution, origin: of the grid, as a `Heightfield` has them.
      upward_only: count for `under` only triangles whose normal points up: those of a solid that one can stand on.
    """
    nrow, ncol = shape
    # Work in cells from the first point. Vertical triangles cover no point; their neighbours end where they stand.
    corners = (vertices * (1 / resolution, 1 / resolution, 1) - (*np.array(origin) / resolution, 0))[faces]
    edges = np.roll(corners, -1, axis=1)[..., :2] - corners[..., :2]
    area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    first = np.ceil(corners[..., :2].min(axis=1) - TOLERANCE).astype(np.int64).clip(0)
    last = np.floor(corners[..., :2].max(axis=1) + TOLERANCE).astype(np.int64).clip(max=(ncol - 1, nrow - 1))
    sides = (last - first + 1).clip(0)
    used = np.flatnonzero((sides.prod(axis=1) > 0) & (np.abs(area) > 1e-12))
    top, under = np.full(nrow * ncol, -np.inf), np.full(nrow * ncol, np.inf)
    pairs = np.cumsum(sides[used].prod(axis=1))
    cuts = np.searchsorted(pairs, np.arange(CHUNK, pairs[-1] if len(pairs) else 0, CHUNK))
    for chunk in np.split(used, np.unique(cuts)):
        _chunk(corners[chunk], edges[chunk], area[chunk], first[chunk], sides[chunk], ncol, upward_only, top, under)
    return Columns(top.reshape(shape), under.reshape(shape))


def _chunk(
    corners: Array,
    edges: Array,
    area: Array,
    first: NDArray[np.int64],
    sides: NDArray[np.int64],
    ncol: int,
    upward_only: bool,
    top: Array,
    under: Array,
) -> None:
    """Enter some triangles into `top` and `under`: each against all points of its bounding box."""
    counts = sides.prod(axis=1)
    which = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    column = first[which, 0] + within % sides[which, 0]
    row = first[which, 1] + within // sides[which, 0]
    sign = np.sign(area)
    lengths = np.hypot(edges[..., 0], edges[..., 1])
    nearest = np.full(len(which), np.inf)  # signed distance to the closest edge [cells], positive inside
    height = np.zeros(len(which))
    for k in range(3):
        cross = (row - corners[which, k, 1]) * edges[which, k, 0] - (column - corners[which, k, 0]) * edges[which, k, 1]
        np.minimum(nearest, cross * (sign / np.maximum(lengths[:, k], 1e-12))[which], out=nearest)
        # The share of an edge's area is the weight of the corner opposite to it.
        height += cross * (corners[:, (k + 2) % 3, 2] / area)[which]
    z = corners[..., 2]
    height = np.clip(height, z.min(axis=1)[which], z.max(axis=1)[which])
    point = row * ncol + column
    covered = nearest >= -TOLERANCE
    np.maximum.at(top, point[covered], height[covered])
    inside = nearest > TOLERANCE
    if upward_only:
        inside &= (area > 0)[which]
    np.minimum.at(under, point[inside], height[inside])
