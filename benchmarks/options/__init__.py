"""What benchmarks share of their command lines: numbers with bounds, the file for the rows, and how a run ends."""

import argparse
import json
import math
import os
import platform
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import nfc_gym
from nfc_gym.core.errors import InputError, NfcError
from nfc_gym.core.files import write_whole


def count(least: int) -> Callable[[str], int]:
    """A whole number of at least so many, as the `type` of an argument."""

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(f"{text!r}: want a whole number of at least {least}")
        return value

    return read


def number(least: float, most: float = math.inf) -> Callable[[str], float]:
    """A number within bounds, as the `type` of an argument."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            upper = f"of at least {least:g}" if math.isinf(most) else f"from {least:g} to {most:g}"
            raise argparse.ArgumentTypeError(f"{text!r}: want a number {upper}")
        return value

    return read


def json_file(text: str) -> Path:
    """A file that the rows can be written to, as the `type` of an argument: asked before the run, not after it."""
    path = Path(text)
    if path.is_dir():
        raise argparse.ArgumentTypeError(f"{text!r} is a folder: want a file")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise argparse.ArgumentTypeError(f"{text!r}: its folder cannot be made: {error.strerror}") from None
    return path


def made(args: argparse.Namespace) -> dict[str, Any]:
    """How figures were made, to stand beside their rows: date, machine, versions and the command's settings.

    Of folders and files only the names: where they lay says nothing of the figures.
    """
    settings = {k: [_plain(v) for v in s] if isinstance(s, list | tuple) else _plain(s) for k, s in vars(args).items()}
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "machine": {"processor": _processor(), "cores": os.cpu_count()},
        "versions": {
            "python": platform.python_version(), "numpy": np.__version__, "mujoco": mujoco.__version__,
            "nfc_gym": nfc_gym.__version__,
        },
        "settings": settings,
    }  # fmt: skip


def _plain(setting: Any) -> Any:
    return setting.name if isinstance(setting, Path) else setting


def _processor() -> str:
    """Its name as the system says it."""
    about = Path("/proc/cpuinfo")
    lines = about.read_text(encoding="utf-8").splitlines() if about.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def write_json(path: Path, content: Any) -> None:
    """Whole or not at all; what is not finite becomes null, which JSON has."""
    text = json.dumps(_finite(content), indent=1, allow_nan=False)
    if path.exists() and not path.is_file():  # such as /dev/stdout
        path.write_text(text, encoding="utf-8")
    else:
        write_whole(path, text)


def read_json(path: Path, *keys: str) -> dict[str, Any]:
    """What another run's `--json` wrote, with these keys.

    Raises:
      InputError: the file is not there, or is something else.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; want the file that a run's --json wrote") from None
    except ValueError:
        content = None
    if not isinstance(content, dict) or not set(keys) <= content.keys():
        raise InputError(f"{path} is not what a run's --json wrote: want JSON with {', '.join(keys)}")
    return content


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {k: _finite(v) for k, v in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(v) for v in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def ended(main: Callable[[], int | None]) -> int:
    """Run a benchmark's `main`; bad input ends in a line and 2, as with `nfc-gym`, and Ctrl-C in 130."""
    try:
        return main() or 0
    except NfcError as error:
        print(f"{Path(sys.argv[0]).stem}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
