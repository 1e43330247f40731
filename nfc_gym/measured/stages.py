"""What a run has finished so far, kept in its output folder so that an interrupted run goes on from there."""

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

from nfc_gym.core.errors import InputError
from nfc_gym.core.files import write_whole

_FOLDER = ".stages"
OUTPUTS = ("report.json", "report.html", "model.xml", "effects.yaml", "fit.json")


def digest(*files: Path, extra: str = "") -> str:
    """SHA-256 of files' contents and a text."""
    sha = hashlib.sha256(extra.encode())
    for file in files:
        sha.update(file.read_bytes())
    return sha.hexdigest()


class Stages:
    """Finished stages of one run.

    Args:
      out: the output folder; made here.
      key: digest of everything that the results depend on; stages of another key are not used.
      overwrite: remove what an earlier run left.
      resume: use finished stages of an interrupted run with the same key.

    Raises:
      InputError: the folder holds a finished run, or anything that this command did not write.
    """

    def __init__(self, out: Path, key: str, overwrite: bool, resume: bool) -> None:
        self.folder = out / _FOLDER
        if out.exists() and not out.is_dir():
            raise InputError(f"{out} exists and is not a folder: choose another --out")
        if out.exists() and not overwrite:
            self._refuse(out, key)
        if self.folder.exists() and (overwrite or not resume or self._key() != key):
            shutil.rmtree(self.folder)
        if overwrite:
            for name in OUTPUTS:
                (out / name).unlink(missing_ok=True)
        self.folder.mkdir(parents=True, exist_ok=True)
        write_whole(self.folder / "key", key)

    def _key(self) -> str:
        file = self.folder / "key"
        return file.read_text() if file.exists() else ""

    def _refuse(self, out: Path, key: str) -> None:
        foreign = sorted(
            p.name for p in out.iterdir() if p.name not in (*OUTPUTS, _FOLDER) and not p.name.startswith(".")
        )
        if (out / "report.json").exists():
            raise InputError(
                f"{out} holds the report of a finished run: choose another --out, or say --overwrite to replace it"
            )
        if foreign and not self.folder.exists():
            raise InputError(
                f"{out} exists and holds {foreign[0]!r}, which is not a run's: choose another --out, or say --overwrite"
            )
        if self.folder.exists() and self._key() not in ("", key):
            raise InputError(
                f"{out} holds an unfinished run on other inputs or another seed: "
                "choose another --out, or say --overwrite"
            )

    def get(self, name: str) -> Any | None:
        """Result of a finished stage, or None."""
        file = self.folder / f"{name}.json"
        return json.loads(file.read_text()) if file.exists() else None

    def put(self, name: str, result: Any) -> None:
        """Keep a finished stage."""
        write_whole(self.folder / f"{name}.json", json.dumps(result))
