"""Heightfields: generation, mesh import and export, elevation maps, what a depth camera makes of them.

Needs numpy and OpenCV; trimesh where meshes are read or written. MuJoCo's models are only ever handed in.
"""

from nfc_gym.terrain.camera import DepthCamera
from nfc_gym.terrain.egocentric import elevation
from nfc_gym.terrain.generate import KINDS, make, obstacles, pool
from nfc_gym.terrain.heightfield import RESOLUTION, SHAPE, Heightfield, surface
from nfc_gym.terrain.lay import lay
from nfc_gym.terrain.mesh import from_mesh, to_mesh
from nfc_gym.terrain.model import HfieldAsset, asset, bounds, write, write_pool
from nfc_gym.terrain.perceived import PerceivedMap

__all__ = [
    "KINDS",
    "RESOLUTION",
    "SHAPE",
    "DepthCamera",
    "Heightfield",
    "HfieldAsset",
    "PerceivedMap",
    "asset",
    "bounds",
    "elevation",
    "from_mesh",
    "lay",
    "make",
    "obstacles",
    "pool",
    "surface",
    "to_mesh",
    "write",
    "write_pool",
]
