"""What a run has finished so far, kept in its output folder so that an interrupted run goes on from there."""

import hashlib
import json
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nfc_gym.core.errors import InputError
from nfc_gym.core.files import write_whole

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_FOLDER, _LOCK, _SECONDS = ".stages", ".lock", "seconds"
OUTPUTS = ("report.json", "report.html", "model.xml", "effects.yaml", "fit.json")


def digest(*files: Path, extra: str | bytes = "") -> str:
    """SHA-256 of files' contents and a text or bytes."""
    sha = hashlib.sha256(extra.encode() if isinstance(extra, str) else extra)
    for file in files:
        sha.update(file.read_bytes())
    return sha.hexdigest()


class Stages:
    """Finished stages of one run.

    A finished run leaves its key behind and no stage; stages therefore mark an unfinished run, which the same command
    continues, with `overwrite` too. What an earlier run left is replaced when the new run writes its results, and not
    before: a run that fails or is given up loses nothing.

    Args:
      out: the output folder; made here.
      key: digest of everything that the results depend on; stages of another key are not used.
      overwrite: the results of an earlier run may be replaced.
      resume: use finished stages of an interrupted run with the same key.
      own: names in the folder that belong to this run besides its outputs.

    Raises:
      InputError: the folder holds a finished run, or anything that this command did not write.
    """

    def __init__(self, out: Path, key: str, overwrite: bool, resume: bool, own: Iterable[str] = ()) -> None:
        require_free(out, key, overwrite, own)
        self.folder = out / _FOLDER
        if self.folder.exists() and not (resume and written_by(out, key)):
            shutil.rmtree(self.folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        write_whole(self.folder / "key", key)
        self._began, self._before = time.monotonic(), float(self.get(_SECONDS) or 0.0)

    @property
    def seconds(self) -> float:
        """Spent on the run [s]; what was interrupted counts up to its last finished stage."""
        return self._before + time.monotonic() - self._began

    def get(self, name: str) -> Any:
        """Result of a finished stage, or None."""
        file = self.folder / f"{name}.json"
        return json.loads(file.read_text(encoding="utf-8")) if file.exists() else None

    def put(self, name: str, result: Any) -> None:
        """Keep a finished stage."""
        for file, content in ((name, result), (_SECONDS, self.seconds)):
            write_whole(self.folder / f"{file}.json", json.dumps(content))

    def finish(self) -> None:
        """The results are written: forget the stages, and remember whose they are."""
        for file in self.folder.iterdir():
            if file.name != "key":
                file.unlink()


@contextmanager
def held(out: Path) -> Iterator[None]:
    """A folder, made here, that no other run may write to meanwhile; the system lets go of it when a run is killed.

    Raises:
      InputError: another run writes there.
    """
    out.mkdir(parents=True, exist_ok=True)
    with (out / _LOCK).open("wb") as handle:
        try:
            if fcntl is not None:  # elsewhere whoever starts two runs is not told
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{out}: another run is writing there: wait for it, or choose another --out") from None
        except OSError:  # a file system without locks
            pass
        yield


def require_free(out: Path, key: str | None, overwrite: bool, own: Iterable[str] = ()) -> None:
    """Whether a run may write to a folder; the arguments and what is raised are those of `Stages`.

    A `key` that is not known yet, None, leaves open whose unfinished run lies there.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} exists and is not a folder: choose another --out")
    if not out.exists() or overwrite:
        return
    known = {*own, *OUTPUTS, _FOLDER}
    foreign = sorted(p.name for p in out.iterdir() if p.name not in known and not p.name.startswith("."))
    begun = (out / _FOLDER).exists()
    if (out / "report.json").exists():
        raise InputError(
            f"{out} holds the report of a finished run: choose another --out, or say --overwrite to replace it"
        )
    if foreign and not begun:
        raise InputError(
            f"{out} exists and holds {foreign[0]!r}, which is not a run's: choose another --out, or say --overwrite"
        )
    if begun and key is not None and _key(out) not in ("", key):
        raise InputError(
            f"{out} holds an unfinished run on other inputs or another seed: choose another --out, or say --overwrite"
        )


def written_by(out: Path, key: str) -> bool:
    """Whether what lies in a folder, finished or not, is of a run with this key."""
    return _key(out) == key


def _key(out: Path) -> str:
    file = out / _FOLDER / "key"
    return file.read_text(encoding="utf-8") if file.exists() else ""
