"""A terrain as heights over a grid, and the surface that MuJoCo collides with between the grid's points.

MuJoCo splits each cell along the diagonal from `heights[r, c]` to `heights[r + 1, c + 1]`, for contacts and rays alike,
so the surface between grid points is piecewise linear over triangles, not bilinear. `height` and `normal` follow that.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import is_number, real_array

Array = NDArray[np.float64]

SHAPE = (256, 256)  # rows, columns of a default map: 25.5 m x 25.5 m, twice the elevation map's 12.8 m
RESOLUTION = 0.1  # m a cell: the elevation map's own, so that nothing is lost between the two


@dataclass(frozen=True, init=False, eq=False)
class Heightfield:
    """Heights over a regular grid; immutable.

    Attributes:
      heights: (nrow, ncol) float32 [m], read-only; x grows with the column and y with the row, as in MuJoCo.
      resolution: distance of neighbouring points [m], the same along x and y.
      origin: world x and y of `heights[0, 0]` [m]; by default the map's centre lies at the world's origin.

    Raises:
      InputError: `heights` is no finite array of at least 2 x 2, or `resolution` or `origin` is no usable number.
    """

    heights: NDArray[np.float32]
    resolution: float
    origin: tuple[float, float]

    def __init__(
        self, heights: ArrayLike, resolution: float = RESOLUTION, origin: tuple[float, float] | None = None
    ) -> None:
        given = real_array(heights)
        if given is None:
            text = repr(heights)
            raise InputError(f"heights are {text if len(text) <= 80 else text[:77] + '...'}; want an array of numbers")
        grid = np.array(given, np.float32, order="C")
        if grid.ndim != 2 or min(grid.shape) < 2:
            raise InputError(f"heights have shape {grid.shape}; want (nrow, ncol), both at least 2")
        if not np.isfinite(grid).all():
            row, col = np.argwhere(~np.isfinite(grid))[0]
            raise InputError(f"heights[{row}, {col}] is {grid[row, col]}; want finite heights in metres")
        if not is_number(resolution) or resolution <= 0:
            raise InputError(f"resolution {resolution!r}: want metres a cell, above 0")
        if origin is None:
            origin = (-0.5 * (grid.shape[1] - 1) * resolution, -0.5 * (grid.shape[0] - 1) * resolution)
        place = real_array(origin)
        if place is None or place.shape != (2,) or not np.isfinite(place).all():
            raise InputError(f"origin {origin!r}: want the world x and y of heights[0, 0] in metres")
        grid.flags.writeable = False
        object.__setattr__(self, "heights", grid)
        object.__setattr__(self, "resolution", float(resolution))
        object.__setattr__(self, "origin", (float(origin[0]), float(origin[1])))

    def __repr__(self) -> str:
        nrow, ncol = self.heights.shape
        low, high = self.heights.min(), self.heights.max()
        return f"Heightfield({nrow} x {ncol} at {self.resolution:g} m from {self.origin}, {low:.3g} to {high:.3g} m)"

    @property
    def extent(self) -> tuple[float, float]:
        """Size along x and y from the first to the last point [m]."""
        nrow, ncol = self.heights.shape
        return (ncol - 1) * self.resolution, (nrow - 1) * self.resolution

    @property
    def centre(self) -> tuple[float, float]:
        """World x and y of the middle of the map [m]."""
        return self.origin[0] + self.extent[0] / 2, self.origin[1] + self.extent[1] / 2

    def height(self, xy: ArrayLike) -> Array:
        """Height of MuJoCo's collision surface below (or above) world points.

        Args:
          xy: (..., 2) world x and y [m]; points beyond the edge take the nearest point of the edge.

        Returns:
          (...) [m].

        Raises:
          InputError: what is given are no points, or not finite.
        """
        return surface(self.heights, _points(xy), self.resolution, self.origin)[0]

    def height_at(self, x: float, y: float) -> float:
        """`height` of one point, two finite numbers, to the same bits, in a tenth of the time."""
        nrow, ncol = self.heights.shape
        right = min(max((x - self.origin[0]) / self.resolution, 0.0), ncol - 1.0)
        up = min(max((y - self.origin[1]) / self.resolution, 0.0), nrow - 1.0)
        col, row = min(int(right), ncol - 2), min(int(up), nrow - 2)
        u, v = right - col, up - row
        near, far = self.heights.item(row, col), self.heights.item(row + 1, col + 1)
        if u >= v:
            corner = self.heights.item(row, col + 1)
            return near + (corner - near) * u + (far - corner) * v
        corner = self.heights.item(row + 1, col)
        return near + (far - corner) * u + (corner - near) * v

    def normal(self, xy: ArrayLike) -> Array:
        """Upward unit normal of MuJoCo's collision surface, that of the edge's triangle beyond the edge.

        Args:
          xy: (..., 2) world x and y [m].

        Returns:
          (..., 3) unit vectors.

        Raises:
          InputError: what is given are no points, or not finite.
        """
        _, slope_x, slope_y = surface(self.heights, _points(xy), self.resolution, self.origin)
        normal = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=-1)
        return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _points(xy: ArrayLike) -> Array:
    """(..., 2) points; what is none raises `InputError`."""
    points = real_array(xy)
    if points is None or points.shape[-1:] != (2,) or not np.isfinite(points).all():
        text = repr(xy)
        shown = text if len(text) <= 80 else f"{text[:77]}..."
        raise InputError(f"xy is {shown}; want finite world points (..., 2) in metres")
    return points


def surface(
    heights: NDArray[np.floating],
    xy: ArrayLike,
    resolution: float,
    origin: tuple[float, float],
    which: NDArray[np.integer] | None = None,
) -> tuple[Array, Array, Array]:
    """Height and gradient of the collision surface at points, for one map or for each point's own of a stack of maps.

    Args:
      heights: (nrow, ncol), or (k, nrow, ncol) with `which`.
      xy: (..., 2) world x and y [m]; clamped to the map.
      resolution, origin: of every map of the stack.
      which: integers that broadcast against (...): the map below each point.

    Returns:
      Height [m], its derivative along x and its derivative along y, each (...).
    """
    nrow, ncol = heights.shape[-2:]
    points = np.asarray(xy, np.float64)
    col, u = _cell((points[..., 0] - origin[0]) / resolution, ncol)
    row, v = _cell((points[..., 1] - origin[1]) / resolution, nrow)
    # One flat index and three offsets: the fourth corner is never needed, as each point lies in one triangle.
    start = row * ncol + col if which is None else (np.asarray(which) * nrow + row) * ncol + col
    flat = heights.reshape(-1)
    right = u >= v  # the triangle with the corners (r, c), (r, c + 1), (r + 1, c + 1); else the one with (r + 1, c)
    near = flat[start].astype(np.float64)
    corner = flat[start + np.where(right, 1, ncol)].astype(np.float64)
    far = flat[start + ncol + 1].astype(np.float64)
    along_x = np.where(right, corner - near, far - corner)
    along_y = np.where(right, far - corner, corner - near)
    return near + along_x * u + along_y * v, along_x / resolution, along_y / resolution


def _cell(position: Array, count: int) -> tuple[NDArray[np.intp], Array]:
    """Index of the cell that holds a grid position, and the position within it in [0, 1]; beyond the edge clamped."""
    position = np.clip(position, 0.0, count - 1)
    index = np.minimum(position.astype(np.intp), count - 2)
    return index, position - index
