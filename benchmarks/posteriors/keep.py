"""Finished results under DIR: each is computed once, and belongs to the settings that it was computed with."""

import json
import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nfc_gym.core.errors import InputError


def begun(out: Path, given: int | None) -> int:
    """The seed that a folder was begun with, else the given one, else a new one; the folder keeps it in `seed.json`.

    Raises:
      InputError: another one is given than the folder was begun with.
    """
    file = out / "seed.json"
    kept = json.loads(file.read_text()) if file.is_file() else None
    if kept is not None and given not in (None, kept):
        raise InputError(f"{out} was begun with seed {kept}, not {given}: leave --seed out, or choose another folder")
    seed = kept if kept is not None else given if given is not None else secrets.randbits(31)
    out.mkdir(parents=True, exist_ok=True)
    write(file, seed)
    return seed


def belongs(out: Path, settings: dict[str, Any]) -> None:
    """Keep in a folder what its results depend on beside their names.

    Raises:
      InputError: it holds results of other settings.
    """
    file = out / "settings.json"
    if file.is_file():
        before = json.loads(file.read_text())
        odd = [f"{k} {before.get(k)}, not {v}" for k, v in settings.items() if before.get(k) != v]
        if odd:
            raise InputError(f"{out} holds results of {', '.join(odd)}: give those, or another folder")
    write(file, settings)


class Kept:
    """Results by name, one JSON file each.

    Args:
      out: the folder.
      settings: what results depend on beside their names.

    Raises:
      InputError: the folder holds results of other settings.
    """

    def __init__(self, out: Path, settings: dict[str, Any]) -> None:
        self.cells, self.out = out / "cells", out
        self.cells.mkdir(parents=True, exist_ok=True)
        belongs(out, settings)

    def once(self, name: str, make: Callable[[], dict[str, Any]], **of: Any) -> dict[str, Any]:
        """What `make` gives, or gave when it was called for this name before; what is `missing` is tried again.

        Args:
          name: of the result.
          make: see above.
          of: kept with the result: settings that differ from one to the next.

        Raises:
          InputError: what is kept was made of something else.
        """
        file = self.cells / f"{name}.json"
        if file.is_file():
            found = json.loads(file.read_text())
            odd = [f"{k} {found.get(k)}, not {v}" for k, v in of.items() if found.get(k) != v]
            if odd and "missing" not in found:
                raise InputError(f"{file} is of {', '.join(odd)}: give that, or another folder")
            if "missing" not in found:
                return found
        write(file, make() | of)
        return json.loads(file.read_text())

    def has(self, name: str) -> bool:
        """Whether there is a result of that name."""
        return (self.cells / f"{name}.json").is_file()

    def get(self, name: str) -> dict[str, Any]:
        """A result that there is."""
        return json.loads((self.cells / f"{name}.json").read_text())

    def keep(self, name: str, found: dict[str, Any]) -> None:
        """Write a result, over an earlier one of that name."""
        write(self.cells / f"{name}.json", found)

    def folder(self, name: str) -> Path:
        """Where training keeps its state."""
        return self.out / "training" / name

    def values(self) -> dict[str, dict[str, Any]]:
        """Every result that there is, by name."""
        return results(self.out)


def results(out: Path) -> dict[str, dict[str, Any]]:
    """Every result that is kept in a folder, by name."""
    return {f.stem: json.loads(f.read_text()) for f in sorted((out / "cells").glob("*.json"))}


def write(file: Path, value: Any) -> None:
    """As JSON, see `write_text`."""
    write_text(file, json.dumps(value, indent=1))


def write_text(file: Path, text: str) -> None:
    """Whole or not at all, also where several processes write it."""
    part = file.with_name(f"{file.name}.{os.getpid()}.part")
    part.write_text(text)
    part.replace(file)
