"""Mesh files: opening what others send, in metres and with z up, and writing."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError

if TYPE_CHECKING:
    import trimesh

Array = NDArray[np.float64]

SUFFIXES = (".stl", ".obj", ".glb", ".ply")


def load(
    mesh: "str | Path | trimesh.Trimesh", scale: float, up: str | None, closed: bool
) -> tuple[Array, NDArray[np.integer], bool]:
    """Read and check a mesh, from a file where a path is given; the arguments are those of `from_mesh`.

    Returns:
      Vertices (v, 3) [m] with z up; faces (f, 3); and whether the faces' normals point out of the ground.
    """
    import trimesh

    up = _upward(mesh) if up is None else up
    if up not in ("y", "z"):
        raise InputError(f"up {up!r}: want 'y' or 'z'")
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"scale {scale!r}: want a factor above 0")
    source = "the mesh" if isinstance(mesh, trimesh.Trimesh) else str(mesh)
    mesh = mesh if isinstance(mesh, trimesh.Trimesh) else _read(Path(mesh))
    if len(mesh.faces) == 0:
        raise InputError(f"{source} is empty: it has no triangles")
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{source} has vertices that are not finite")
    if closed and not mesh.is_watertight:
        raise InputError(
            f"{source} is open: some edges belong to one triangle only. Close it, or leave out `closed`"
            " to have its holes filled from the nearest surface"
        )
    mesh = _turned(mesh, 1) if up == "y" else mesh
    vertices, faces = np.asarray(mesh.vertices, np.float64) * scale, np.asarray(mesh.faces)
    # Sums of signed areas or volumes tell outside from inside where neighbouring triangles agree on it.
    oriented = mesh.is_winding_consistent
    inverted = mesh.volume < 0 if mesh.is_watertight else (mesh.face_normals[:, 2] * mesh.area_faces).sum() < 0
    return vertices, faces[:, ::-1] if oriented and inverted else faces, oriented


def _read(path: Path) -> "trimesh.Trimesh":
    import trimesh

    suffix = _suffix(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        scene = trimesh.load_scene(path, file_type=suffix[1:], skip_materials=True)
        return scene.to_mesh()
    except Exception as error:  # trimesh's readers raise whatever a broken file makes them stumble over
        raise InputError(f"{path}: cannot be read as {suffix[1:].upper()} ({type(error).__name__}: {error})") from error


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: no format is known by {suffix!r}; want one of {', '.join(SUFFIXES)}")
    return suffix


def _upward(mesh: object) -> str:
    return "y" if isinstance(mesh, str | Path) and Path(mesh).suffix.lower() == ".glb" else "z"


def _turned(mesh: "trimesh.Trimesh", quarters: int) -> "trimesh.Trimesh":
    """A copy turned about x: by one quarter y becomes z, by minus one z becomes y."""
    turn = np.eye(4)
    turn[1:3, 1:3] = [[0, -quarters], [quarters, 0]]
    copy = mesh.copy()
    copy.apply_transform(turn)
    return copy


def save(mesh: "trimesh.Trimesh", path: Path) -> None:
    """Write a mesh whose z is up in the format that the suffix names; raises `InputError` for any other suffix."""
    _suffix(path)
    (_turned(mesh, -1) if _upward(path) == "y" else mesh).export(path)
