"""The scene around a robot: ground (a plane, or heightfields to choose from), light and sky; heights written into it.

All heightfields of a scene have one size and one place, and that size leaves room for any map between `LOWEST` and
`HIGHEST`. So a map is changed by its data alone and chosen by `geom_dataid` alone, with nothing to recompute.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.parameters import numbers
from nfc_gym.terrain.heightfield import RESOLUTION, SHAPE, Heightfield
from nfc_gym.terrain.model import HfieldAsset, asset

GROUND = "ground"
TIMESTEP = 0.005  # s, physics 200 Hz
LOWEST, HIGHEST = -5.0, 11.0  # m: what a map may hold; in float32 that still resolves a micrometre
SOLID = 1.0  # m of ground below LOWEST


def build(mjcf: Path, maps: int, change: Callable[[mujoco.MjSpec], None] | None = None) -> mujoco.MjModel:
    """Compile a robot's MJCF with ground below it.

    Args:
      mjcf: the robot; a ground of its own is replaced, light and sky are added where it has none.
      maps: how many heightfields, named `terrain_0`, ...; 0 gives a plane.
      change: edits the description before it is compiled: what a robot's machine has and its MJCF does not say.
    """
    rows, cols = SHAPE
    size = ((cols - 1) * RESOLUTION / 2, (rows - 1) * RESOLUTION / 2, HIGHEST - LOWEST, SOLID)
    flat = HfieldAsset(rows, cols, size, np.zeros(rows * cols, np.float32), (0, 0, LOWEST))
    described = _describe(mjcf, [flat] * maps)
    if change is not None:
        change(described)
    model = described.compile()
    for k in range(maps):
        write(model, k, np.zeros(SHAPE, np.float32))
    return model


def text(mjcf: Path, ground: Heightfield | None) -> str:
    """MJCF of the same scene on one map, or on a plane, for whoever simulates it outside this package."""
    spec = _describe(mjcf, [] if ground is None else [asset(ground)])
    spec.compile()
    return spec.to_xml()


def _describe(mjcf: Path, maps: Sequence[HfieldAsset]) -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_file(str(mjcf))
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # An unstable simulation is to be seen as such, not to be reset silently in the midst of a control step.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    old = spec.geom(GROUND)
    if old is not None:
        spec.delete(old)
    _light(spec)
    ground = dict(name=GROUND, material=GROUND, contype=1, conaffinity=1, friction=[1, 0.005, 0.0001])
    for k, each in enumerate(maps):
        spec.add_hfield(name=f"terrain_{k}", size=each.size, nrow=each.nrow, ncol=each.ncol, userdata=each.data)
    if maps:
        kind = mujoco.mjtGeom.mjGEOM_HFIELD
        spec.worldbody.add_geom(type=kind, hfieldname="terrain_0", pos=maps[0].pos, **ground)
    else:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05], **ground)
    return spec


def _light(spec: mujoco.MjSpec) -> None:
    """Sky, the ground's material and a sun, where the robot's file has none of that name."""
    textures = {t.name for t in spec.textures}
    if "sky" not in textures:
        sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=256, height=1536)
        sky.builtin = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
        sky.rgb1, sky.rgb2 = [0.55, 0.70, 0.88], [0.93, 0.95, 0.97]
    if GROUND not in textures:
        tile = spec.add_texture(name=GROUND, type=mujoco.mjtTexture.mjTEXTURE_2D, width=300, height=300)
        tile.builtin, tile.mark = mujoco.mjtBuiltin.mjBUILTIN_CHECKER, mujoco.mjtMark.mjMARK_EDGE
        tile.rgb1, tile.rgb2, tile.markrgb = [0.56, 0.59, 0.57], [0.49, 0.52, 0.51], [0.70, 0.72, 0.71]
    if GROUND not in {m.name for m in spec.materials}:
        material = spec.add_material(name=GROUND, texuniform=True, texrepeat=[1, 1])
        material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = GROUND
    if not spec.lights:
        spec.worldbody.add_light(
            name="sun",
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=[1, -0.6, 4],
            dir=[-0.25, 0.15, -1],
            diffuse=[0.7, 0.7, 0.68],
        )


def checked(heights: ArrayLike, name: str = "heightfield") -> Heightfield:
    """Heights as a `Heightfield` that the scene can hold.

    Raises:
      InputError: another shape than `SHAPE`, values that are not finite, or outside [LOWEST, HIGHEST].
    """
    grid = heights.heights if isinstance(heights, Heightfield) else np.asarray(numbers(heights, name), np.float32)
    if grid.shape != SHAPE:
        raise InputError(f"{name} has shape {grid.shape}, want {SHAPE} (rows along y, columns along x)")
    if not np.isfinite(grid).all():
        raise InputError(f"{name} holds values that are not finite")
    if grid.min() < LOWEST or grid.max() > HIGHEST:
        raise InputError(f"{name} reaches from {grid.min():g} to {grid.max():g} m, want {LOWEST:g} to {HIGHEST:g} m")
    if not isinstance(heights, Heightfield):
        return Heightfield(grid)
    here = Heightfield(grid)
    if heights.resolution != here.resolution or heights.origin != here.origin:
        raise InputError(f"{name} is {heights!r}, want {here.resolution:g} m a cell from {here.origin}")
    return heights


def risen(ground: Heightfield, residual: ArrayLike) -> Heightfield:
    """Ground plus a residual (rows, columns) m; errors as `checked`."""
    residual = numbers(residual, "terrain_residual")
    if residual.shape != SHAPE:
        raise InputError(f"terrain_residual has shape {residual.shape}, want {SHAPE} (rows along y, columns along x)")
    return checked((ground.heights + residual).astype(np.float32), "the terrain with terrain_residual")


def write(model: mujoco.MjModel, index: int, heights: NDArray[np.float32]) -> None:
    """Heights (rows, columns) m into heightfield `index` of a model that `build` made."""
    start = int(model.hfield_adr[index])
    scaled = (heights.astype(np.float64) - LOWEST) / (HIGHEST - LOWEST)
    model.hfield_data[start : start + heights.size] = scaled.ravel()
