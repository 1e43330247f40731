"""Lets the tests here import `cases`, what they are all run over."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that wrappers are given as sources, so that their specs can be written as JSON."""
    from cases import write_sources

    return write_sources(tmp_path_factory.mktemp("sources"))
