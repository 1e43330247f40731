"""What a file or folder of this package is, told from its beginning alone, lest another kind is written over it."""

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

from nfc_gym.core.errors import InputError
from nfc_gym.core.fidelity import PARTS

POSTERIOR, STRUCTURE, DETECTOR, POLICY = "a posterior", "a structure head", "an anomaly detector", "a policy"
TRAINING, LEARNING = "the state of training a posterior", "the state of training a policy"
DRAWS, WINDOW, ARRAYS = "draws from a posterior", "a window of motion", "named arrays"
WINDOWS, ADAPTED, LEARNED = "a set of windows", "what `nfc-gym adapt` wrote", "what `nfc-gym learn` wrote"
REPORT, DEMO = "what `nfc-gym close-loop` wrote", "what `nfc-gym demo` wrote"
FOLDER, EMPTY = "a folder", "an empty file"
_RUN = f"a folder with {TRAINING}"
_FOLDERS = (WINDOWS, ADAPTED, LEARNED, REPORT, DEMO, _RUN)

# The `format` in a safetensors file's metadata, without its version.
_FORMATS = {
    "nfc_gym-posterior": POSTERIOR,
    "nfc_gym-normal": POSTERIOR,
    "nfc_gym-detector": DETECTOR,
    "nfc_gym-policy": POLICY,
    "nfc_gym-training": TRAINING,
    "nfc_gym-learning": LEARNING,
}
# Of folders: a file in them, a key of its JSON, and what the folder then is; the first that fits.
_MARKS = (
    ("manifest.json", "psi_names", WINDOWS),
    ("learned.json", "of", LEARNED),
    ("envelope.json", "family", DEMO),
    ("report.json", "returns", ADAPTED),
    ("report.json", "verdict", REPORT),
)
_HEADER = 100_000_000  # bytes that a safetensors header has at most, by its specification
# What lies beside a file of a kind: the ending added to its name, and the kind of that.
_BESIDE: Mapping[str, Mapping[str, str]] = {
    POSTERIOR: {".training": _RUN},
    STRUCTURE: {".training": _RUN},
    POLICY: {".training": LEARNING},
}


def require_kind(path: Path, kind: str) -> None:
    """Refuse to write something of a kind at `path` where something else is, or beside it where its state goes.

    Args:
      path: to be written; an empty file there is free, and so is a folder where a folder is to be.
      kind: of the constants above.

    Raises:
      InputError: something of another kind is there; the message says what.
    """
    beside = _BESIDE.get(kind, {})
    for target, wanted in ((path, kind), *((path.with_name(path.name + end), k) for end, k in beside.items())):
        found = kind_of(target)
        if found is not None and found not in (wanted, FOLDER if wanted in _FOLDERS else EMPTY):
            raise InputError(f"{target} {_clash(target, found, wanted)}: choose another --out")


def _clash(path: Path, found: str, wanted: str) -> str:
    """What is wrong with a path, in words."""
    if wanted in _FOLDERS and not path.is_dir():
        ours = found in (*_FORMATS.values(), STRUCTURE, DRAWS, WINDOW)
        return f"is {found}, not a folder" if ours else "exists and is not a folder"
    if wanted not in _FOLDERS and not path.is_file():
        return f"is {found}, not a file"
    return f"is {found}, and {wanted} would be written there"


def kind_of(path: Path) -> str | None:
    """What lies at `path`, in words; None where nothing does.

    Raises:
      InputError: it cannot be read.
    """
    try:
        if not path.exists():
            return None
        if path.is_dir():
            return _kind_of_folder(path)
        if not path.is_file():
            return "a device"
        with path.open("rb") as file:
            start = file.read(2)
        return EMPTY if not start else _kind_of_archive(path) if start == b"PK" else _kind_of_tensors(path)
    except OSError as e:
        raise InputError(f"{path} cannot be read ({e.strerror or e}): choose another --out") from None


def _kind_of_folder(folder: Path) -> str:
    """By the file that says what the others are; what an interrupted run leaves may have none yet."""
    for name, key, kind in _MARKS:
        file = folder / name
        if file.is_file() and key in _json(file.read_bytes()):
            return kind
    state = kind_of(folder / "training.safetensors")
    return {TRAINING: _RUN, LEARNING: ADAPTED}.get(state or "", FOLDER)


def _kind_of_archive(path: Path) -> str:
    """Of an npz: by the names of its arrays."""
    try:
        with ZipFile(path) as archive:
            names = {name.removesuffix(".npy") for name in archive.namelist()}
    except (BadZipFile, ValueError):
        return "a damaged archive"
    if names and names <= set(PARTS):
        return DRAWS
    return WINDOW if {"states", "actions"} <= names else ARRAYS


def _kind_of_tensors(path: Path) -> str:
    """Of a safetensors file: by its metadata; the weights are not read."""
    with path.open("rb") as file:
        start = file.read(8)
        size = struct.unpack("<Q", start)[0] if len(start) == 8 else 0
        header = _json(file.read(size)) if 0 < size <= min(_HEADER, path.stat().st_size) else {}
    if not header:
        return "a file of another program"
    about: Any = header.get("__metadata__")
    about = about if isinstance(about, dict) else {}
    given = str(about.get("format", ""))
    kind = _FORMATS.get(given.rpartition("-")[0])
    if kind is None:
        return f"weights of another program (format {given!r})" if given else "weights of another program"
    return STRUCTURE if kind == POSTERIOR and _shows_misfit(about) else kind


def _shows_misfit(metadata: Mapping[str, Any]) -> bool:
    """Whether a posterior's notes say that it was trained as a structure head."""
    notes = _json(str(metadata.get("about", "")).encode()).get("notes")
    return isinstance(notes, dict) and bool(notes.get("misfit"))


def _json(text: bytes) -> dict[str, Any]:
    """A JSON object; anything else is as good as an empty one."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}
