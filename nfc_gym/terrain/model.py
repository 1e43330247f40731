"""Heightfields written into MuJoCo models, one map or a pool from which each simulation takes its own.

A model compiled with other heights needs more than new `hfield_data`: the geom's position and its bounding volumes hold
the old vertical extent, and contacts outside that are lost without a word. `write` mends them all, so that the model
equals one compiled with the map. What it cannot reach: a renderer shows the new heights once the passive viewer's
`update_hfield` or `mjr_uploadHField` has sent them, and a running `mujoco.batch.Batch` holds its own copy of the model.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.terrain.heightfield import Heightfield

if TYPE_CHECKING:
    import mujoco

BASE = 1.0  # m of solid ground below the lowest point, so that nothing fast comes out at the bottom
_HFIELD = 1  # mjGEOM_HFIELD; as a number, so that this package works without mujoco


class HfieldAsset(NamedTuple):
    """What `MjSpec.add_hfield(name, nrow, ncol, size, userdata=data)` and its geom's `pos` take for a map.

    Attributes:
      nrow, ncol: shape.
      size: half extents along x and y, elevation, base [m].
      data: (nrow * ncol,) float32, from 0 at the lowest to 1 at the highest bound.
      pos: (3,) where the geom goes in the world [m].
    """

    nrow: int
    ncol: int
    size: tuple[float, float, float, float]
    data: NDArray[np.float32]
    pos: tuple[float, float, float]


def bounds(maps: Sequence[Heightfield]) -> tuple[float, float]:
    """Lowest and highest point over all maps [m]."""
    if not maps:
        raise InputError("no heightfields given; want at least one")
    return min(float(m.heights.min()) for m in maps), max(float(m.heights.max()) for m in maps)


def asset(heightfield: Heightfield, limits: tuple[float, float] | None = None) -> HfieldAsset:
    """A heightfield asset's shape, size and data, and its geom's position.

    Args:
      heightfield: the map.
      limits: heights that data 0 and 1 stand for [m]; by default the map's own lowest and highest. Note that MuJoCo's
        compiler stretches the data of each asset to [0, 1]: with other limits than its own, `write` after compiling.
    """
    low, high = limits or bounds([heightfield])
    span = high - low or 1.0  # a flat map: any elevation will do, its data are all zero
    nrow, ncol = heightfield.heights.shape
    half_x, half_y = (side / 2 for side in heightfield.extent)
    data = ((heightfield.heights.astype(np.float64) - low) / span).astype(np.float32)
    if data.min() < 0 or data.max() > 1:
        raise InputError(f"limits {low:g} to {high:g} m do not hold {heightfield!r}")
    return HfieldAsset(nrow, ncol, (half_x, half_y, span, BASE), data.reshape(-1), (*heightfield.centre, low))


def write(model: "mujoco.MjModel", hfield_name: str, heightfield: Heightfield) -> None:
    """Give a model's heightfield new heights, position and size.

    Args:
      model: changed in place. The geoms of the heightfield belong to the world body and are not turned.
      hfield_name: of the asset.
      heightfield: of the asset's shape.

    Raises:
      InputError: no such asset, another shape, or a geom that moves or is turned.
    """
    write_pool(model, [hfield_name], [heightfield])


def write_pool(model: "mujoco.MjModel", hfield_names: Sequence[str], maps: Sequence[Heightfield]) -> None:
    """Give several heightfield assets new heights with common limits, so that they serve the same geom.

    With the same size, position and bounding volumes, `geom_dataid` alone then says which map a simulation stands on.
    The geoms that refer to any of the assets are moved to the maps' place.

    Raises:
      InputError: as `write`; or maps that differ in shape, resolution or origin.
    """
    if len(hfield_names) != len(maps):
        raise InputError(f"{len(hfield_names)} heightfield assets for {len(maps)} maps; want one each")
    limits = bounds(maps)
    assets = [asset(heightfield, limits) for heightfield in maps]
    if any((a.size, a.pos) != (assets[0].size, assets[0].pos) for a in assets):
        raise InputError("the maps of a pool must share shape, resolution and origin")
    ids = [_identity(model, name, each) for name, each in zip(hfield_names, assets, strict=True)]
    geoms = [
        geom
        for geom in range(model.ngeom)
        if int(model.geom_type[geom]) == _HFIELD and int(model.geom_dataid[geom]) in ids
    ]
    for geom in geoms:
        if model.geom_bodyid[geom] != 0 or not np.array_equal(model.geom_quat[geom], (1, 0, 0, 0)):
            raise InputError(f"geom {model.geom(geom).name!r} of a heightfield must belong to the world, not turned")
    for identity, each in zip(ids, assets, strict=True):
        start = model.hfield_adr[identity]
        model.hfield_data[start : start + each.data.size] = each.data
        model.hfield_size[identity] = each.size
    for geom in geoms:
        _place(model, geom, assets[0])
    if geoms:
        _refit(model, 0)


def _identity(model: "mujoco.MjModel", name: str, wanted: HfieldAsset) -> int:
    names = [model.hfield(k).name for k in range(model.nhfield)]
    if name not in names:
        raise InputError(f"no heightfield is called {name!r}; the model has {', '.join(map(repr, names)) or 'none'}")
    identity = names.index(name)
    shape = int(model.hfield_nrow[identity]), int(model.hfield_ncol[identity])
    if shape != (wanted.nrow, wanted.ncol):
        raise InputError(f"heights have shape {(wanted.nrow, wanted.ncol)}; heightfield {name!r} takes {shape}")
    return identity


def _place(model: "mujoco.MjModel", geom: int, wanted: HfieldAsset) -> None:
    """A geom's position, and the bounds that the compiler would have given it."""
    half_x, half_y, span, base = wanted.size
    model.geom_pos[geom] = wanted.pos
    # Compiled at the body's own frame, a geom keeps it whatever `geom_pos` says; 0 makes the position count.
    model.geom_sameframe[geom] = 0
    model.geom_size[geom] = (half_x, half_y, span / 4 + base / 2)
    model.geom_aabb[geom] = (0, 0, (span - base) / 2, half_x, half_y, (span + base) / 2)
    model.geom_rbound[geom] = np.linalg.norm((half_x, half_y, max(span, base)))


def _refit(model: "mujoco.MjModel", body: int) -> None:
    """Bounding boxes of a body's tree of geoms, from the leaves up; the heightfields' leaves are set anew."""
    first = model.body_bvhadr[body]
    for node in reversed(range(first, first + model.body_bvhnum[body])):
        geom = model.bvh_nodeid[node]
        if geom >= 0:
            if int(model.geom_type[geom]) == _HFIELD:
                model.bvh_aabb[node] = model.geom_aabb[geom]
                model.bvh_aabb[node, :3] += model.geom_pos[geom]
            continue
        boxes = model.bvh_aabb[[child for child in model.bvh_child[node] if child >= 0]]
        low = (boxes[:, :3] - boxes[:, 3:]).min(axis=0)
        high = (boxes[:, :3] + boxes[:, 3:]).max(axis=0)
        model.bvh_aabb[node] = np.concatenate([(low + high) / 2, (high - low) / 2])
