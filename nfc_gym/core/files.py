"""Files that are there whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from secrets import token_hex

from nfc_gym.core.errors import InputError

_ROOM = 20_000_000  # bytes that must be free: results are a few megabytes


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path beside `path` to write to; on success it takes the place of `path`, on failure nothing is left of it.

    Raises:
      InputError: something is there that is no file, such as a device.
    """
    if path.exists() and not path.is_file():
        raise InputError(f"{path} is a {'folder' if path.is_dir() else 'device'}, not a file: choose another")
    with _becoming(path, _part(path)) as part:
        yield part


@contextmanager
def numbered(folder: Path, name: Callable[[int], str], first: int) -> Iterator[tuple[int, Path]]:
    """The next free number of a series of files, and a path to write that one to, as of `replacing`.

    Several processes may add to one series: each number is one's own from the beginning of the writing on, also of one
    that was killed amid it.

    Args:
      folder: of the files.
      name: of the file with a number.
      first: number to begin the search with.
    """
    paths = ((k, folder / name(k)) for k in count(first))
    number, path, part = next((k, p, part) for k, p in paths if (part := _claimed(p)) is not None)
    with _becoming(path, part):
        yield number, part


def _claimed(path: Path) -> Path | None:
    """The part of a file of a series, which nobody else gets; None where it is being written, or there."""
    part = path.with_name(f".{path.name}.part")
    try:
        part.touch(exist_ok=False)
    except FileExistsError:
        return None
    if not path.exists():
        return part
    part.unlink()
    return None


def _part(path: Path) -> Path:
    """A file beside `path` that nobody else writes to, who may be about to replace it too."""
    return path.with_name(f".{path.name}.{os.getpid()}-{token_hex(4)}.part")


@contextmanager
def _becoming(path: Path, part: Path) -> Iterator[Path]:
    """Put a written part in the place of its file, or away."""
    try:
        part.touch()
        mode = part.stat().st_mode  # as the user's mask has it: safetensors makes files that nobody else may read
        yield part
        os.chmod(part, mode)
        with open(part, "rb") as handle:
            os.fsync(handle.fileno())
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def write_together(folder: Path, texts: Mapping[str, str]) -> None:
    """Write several text files of one folder so that old and new ones are never mixed.

    All are written beside the old ones first, so that a full disk changes nothing. The last one marks that the others
    are there: it is gone while they are replaced.
    """
    parts = {name: _part(folder / name) for name in texts}
    try:
        for name, text in texts.items():
            with open(parts[name], "w", encoding="utf-8", newline="\n") as handle:
                handle.write(text)
                handle.flush()
                os.fsync(handle.fileno())
        (folder / list(texts)[-1]).unlink(missing_ok=True)
        for name, part in parts.items():
            os.replace(part, folder / name)
    except BaseException:
        for part in parts.values():
            part.unlink(missing_ok=True)
        raise


def write_whole(path: Path, text: str) -> None:
    """Write a text file so that it is either the old one or the whole new one, never half of it."""
    with replacing(path) as part, open(part, "w", encoding="utf-8", newline="\n") as handle:
        handle.write(text)


def require_writable(path: Path, option: str = "--out") -> None:
    """Find out, before any work is done, whether a file or folder could be written at `path`; nothing stays behind.

    Args:
      path: where.
      option: by which it was given, for messages.

    Raises:
      InputError: a part of the path is a file, a folder cannot be written to, the disk is full, or the path looks like
        an option whose value was forgotten.
    """
    if str(path).startswith("--"):
        raise InputError(f"--out {path} looks like another option: give --out a value (./{path}, if that is its name)")
    try:
        folder = path
        while not folder.exists():
            folder = folder.parent
        if not folder.is_dir():
            if folder == path:
                raise InputError(f"{path} exists and is not a folder: choose another {option}")
            raise InputError(f"{path}: {folder} is a file, not a folder: choose another {option}")
        tempfile.TemporaryFile(dir=folder).close()
        free = shutil.disk_usage(folder).free
    except OSError as e:
        raise InputError(f"{path} cannot be written ({e.strerror or e}): choose another {option}") from None
    if free < _ROOM:
        raise InputError(
            f"{path}: only {free / 1e6:.0f} MB are free there, and {_ROOM / 1e6:.0f} MB are wanted: "
            f"free some space or choose another {option}"
        )
