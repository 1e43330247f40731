"""Heightfields from and to triangle meshes (STL, OBJ, GLB, PLY), through trimesh.

A heightfield holds one height a column: the topmost surface. What that loses is said by a `UserWarning`: a column with
no surface (a hole) takes the nearest known height, and of several surfaces above each other (an overhang) only the top
one stays.
"""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.terrain.heightfield import RESOLUTION, Heightfield
from nfc_gym.terrain.meshfile import load, save
from nfc_gym.terrain.raster import Columns, rasterise

if TYPE_CHECKING:
    import trimesh

Array = NDArray[np.float64]

LARGEST = 8192  # points a side of a field whose shape comes from the mesh: more is a mistake in the units
FAR = 300.0  # a mesh so many times larger or smaller than the field is in another unit
OVERLAP = 1e-3  # m between two surfaces of a column that count as distinct


def from_mesh(
    mesh: "str | Path | trimesh.Trimesh",
    shape: tuple[int, int] | None = None,
    resolution: float = RESOLUTION,
    origin: tuple[float, float] | None = None,
    *,
    scale: float = 1.0,
    up: str | None = None,
    closed: bool = False,
) -> Heightfield:
    """Heights of a mesh's topmost surface.

    Args:
      mesh: an STL, OBJ, GLB or PLY file, or a mesh.
      shape: (nrow, ncol); by default what the mesh covers.
      resolution: m a cell.
      origin: world x and y of `heights[0, 0]` [m]; by default the mesh's lowest x and y, or with a `shape` whatever
        puts the field in the mesh's middle.
      scale: multiplies the mesh's coordinates: 0.001 for a file in millimetres.
      up: "z" or "y", the mesh's upward axis; by default "y" for GLB files, as glTF has it, and "z" for all others.
      closed: refuse a mesh that is not watertight, where holes are to be found rather than filled.

    Returns:
      The heightfield. A `UserWarning` says how many columns had no surface (filled from the nearest that has one) and
      how many have surfaces below the one taken.

    Raises:
      InputError: a file that cannot be read, an empty mesh, one that is open where `closed` is asked for, one that
        does not cover the field, or one whose size suggests another unit.
    """
    vertices, faces, oriented = load(mesh, scale, up, closed)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    shape, origin = _frame(low, high, shape, resolution, origin)
    columns = rasterise(vertices, faces, shape, resolution, origin, upward_only=oriented)
    hole = ~np.isfinite(columns.top)
    if hole.all():
        raise InputError("the mesh has no surface above the field: seen from above it has no area")
    if hole.any():
        columns.top[hole] = _nearest(columns.top, hole)
    _say(columns, hole)
    return Heightfield(columns.top, resolution, origin)


def to_mesh(
    heightfield: Heightfield, path: str | Path | None = None, *, base: float | None = None
) -> "trimesh.Trimesh":
    """The surface as a mesh whose triangles are those that MuJoCo collides with.

    Args:
      heightfield: of n points.
      path: a file to write, of one of these formats; GLB is turned to have y up, as glTF demands.
      base: thickness below the lowest point [m] of a watertight solid; by default the surface alone.

    Returns:
      The mesh, z up, [m].

    Raises:
      InputError: another suffix, or a `base` that is not above 0.
    """
    import trimesh

    nrow, ncol = heightfield.heights.shape
    x = heightfield.origin[0] + np.arange(ncol) * heightfield.resolution
    y = heightfield.origin[1] + np.arange(nrow) * heightfield.resolution
    top = np.stack([*np.meshgrid(x, y), heightfield.heights.astype(np.float64)], axis=-1).reshape(-1, 3)
    index = np.arange(nrow * ncol).reshape(nrow, ncol)
    near, east, north, far = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate([np.stack([near, east, far], -1), np.stack([near, far, north], -1)]).reshape(-1, 3)
    if base is not None:
        if not base > 0:
            raise InputError(f"base {base!r}: want a thickness above 0")
        bottom = top.copy()
        bottom[:, 2] = top[:, 2].min() - base
        rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
        after, count = np.roll(rim, -1), len(top)
        walls = np.concatenate(
            [np.stack([rim, rim + count, after], -1), np.stack([after, rim + count, after + count], -1)]
        )
        faces = np.concatenate([faces, faces[:, ::-1] + count, walls])
        top = np.concatenate([top, bottom])
    mesh = trimesh.Trimesh(top, faces, process=False)
    if path is not None:
        save(mesh, Path(path))
    return mesh


def _frame(
    low: Array, high: Array, shape: tuple[int, int] | None, resolution: float, origin: tuple[float, float] | None
) -> tuple[tuple[int, int], tuple[float, float]]:
    """Shape and origin of the field; refuses a field that the mesh does not cover."""
    if not (np.isfinite(resolution) and resolution > 0):
        raise InputError(f"resolution {resolution!r}: want metres a cell, above 0")
    size = (high - low)[:2]
    width, depth = size
    if shape is None:
        start = low[:2] if origin is None else np.array(origin, np.float64)
        ncol, nrow = (int(n) for n in np.floor((high[:2] - start) / resolution + 1e-3) + 1)
        if not 2 <= min(nrow, ncol) <= max(nrow, ncol) <= LARGEST:
            raise InputError(
                f"a mesh of {width:g} x {depth:g} m makes {nrow} x {ncol} points of {resolution:g} m; want 2 to"
                f" {LARGEST} a side. If the file is in millimetres, pass scale=0.001; else give a shape"
            )
        return (nrow, ncol), (float(start[0]), float(start[1]))
    if len(shape) != 2 or min(shape) < 2:
        raise InputError(f"shape {shape!r}: want (nrow, ncol), both at least 2")
    field = (np.array(shape[::-1]) - 1) * resolution
    start = (low[:2] + high[:2] - field) / 2 if origin is None else np.array(origin, np.float64)
    told = f"the mesh is {width:g} x {depth:g} m, the field {field[0]:g} x {field[1]:g} m"
    for factor, unit in ((size.max() / field.max(), 0.001), (field.max() / max(size.max(), 1e-12), 1000)):
        if factor > FAR:
            raise InputError(f"{told}: another unit? Pass scale={unit:g} if the mesh is {factor:.0f} times off")
    slack = resolution * (1 + 1e-3)
    if (low[:2] > start + slack).any() or (high[:2] < start + field - slack).any():
        raise InputError(
            f"{told}: from ({low[0]:g}, {low[1]:g}) to ({high[0]:g}, {high[1]:g}) it does not cover the field,"
            f" which goes from ({start[0]:g}, {start[1]:g}) to ({start[0] + field[0]:g}, {start[1] + field[1]:g})"
        )
    return (int(shape[0]), int(shape[1])), (float(start[0]), float(start[1]))


def _nearest(top: Array, hole: NDArray[np.bool_]) -> Array:
    """For each hole the height of the nearest known point."""
    _, labels = cv2.distanceTransformWithLabels(
        hole.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.asarray(labels, np.intp)
    known = np.zeros(nearest.max() + 1)
    known[nearest[~hole]] = top[~hole]
    return known[nearest[hole]]


def _say(columns: Columns, hole: NDArray[np.bool_]) -> None:
    """Warn of holes and overhangs, with a place to look for each."""
    over = columns.top - columns.under > OVERLAP
    for mask, what in (
        (hole, "no surface (a hole); they take the nearest height"),
        (over, "several surfaces above each other (an overhang); they take the topmost"),
    ):
        if mask.any():
            row, col = np.argwhere(mask)[0]
            warnings.warn(
                f"{mask.sum()} of {mask.size} columns have {what}. The first is row {row}, column {col}", stacklevel=3
            )
