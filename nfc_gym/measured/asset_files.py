"""Files of a model's assets, found from wherever the model is written to."""

import os
import re
from pathlib import Path
from xml.sax.saxutils import escape, unescape

import mujoco

_FILE = re.compile(r'(\sfile(?:right|left|up|down|front|back)?=")([^"]+)')
_ESCAPES = {'"': "&quot;"}
_QUOTES = {"&quot;": '"', "&apos;": "'"}


def absolute(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Name the files of meshes, textures, height fields and skins by their whole path.

    Args:
      spec: with its assets, those of models that it includes or attaches among them.
      model: just compiled from it: it knows where each file was found.
    """
    places = {
        "mesh": (spec.meshes, model.mesh_pathadr),
        "texture": (spec.textures, model.tex_pathadr),
        "hfield": (spec.hfields, model.hfield_pathadr),
        "skin": (spec.skins, model.skin_pathadr),
    }
    for kind, (assets, starts) in places.items():
        for asset in assets:
            at = int(starts[asset.id]) if 0 <= int(asset.id) < len(starts) else -1
            read = model.paths[at : model.paths.index(b"\0", at)].decode() if at >= 0 else None
            folder = asset.compiler.texturedir if kind == "texture" else asset.compiler.meshdir
            if asset.file:
                asset.file = _whole(spec, folder, asset.file, read)
            if kind == "texture":
                asset.cubefiles = [_whole(spec, folder, f) if f else f for f in asset.cubefiles]
    spec.meshdir = spec.texturedir = ""
    spec.strippath = False


def _whole(spec: mujoco.MjSpec, folder: str, file: str, read: str | None = None) -> str:
    path = Path(read or Path(spec.modelfiledir, folder, file))
    return os.path.abspath(path) if path.is_file() else file  # what is not on disk, its provider knows by name


def relative(text: str, folder: Path) -> str:
    """MJCF text whose files are named by their whole paths, made to name them as they are found from a folder.

    Both can then be moved together. The text is edited and not its spec, which would look for the files to be written.
    """
    base = os.path.realpath(folder)
    return _FILE.sub(lambda found: found[1] + escape(_from(base, unescape(found[2], _QUOTES)), _ESCAPES), text)


def _from(base: str, file: str) -> str:
    if not os.path.isabs(file):
        return file
    try:
        return Path(os.path.relpath(file, base)).as_posix()
    except ValueError:  # on another drive
        return file
