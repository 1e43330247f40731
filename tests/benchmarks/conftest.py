"""The benchmark's own folder is on the path, as when it is run as a script."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"

sys.path.insert(0, str(Path(__file__).parent))  # `rail`: importlib mode does not add the folder


@pytest.fixture(scope="session", autouse=True)
def _benchmarks_on_the_path() -> Iterator[None]:
    sys.path.insert(0, str(FOLDER))
    importlib.invalidate_caches()
    yield
    sys.path.remove(str(FOLDER))
