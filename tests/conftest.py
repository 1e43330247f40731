"""Shared by all tests: the recordings' folder, and a clear skip where it is absent."""

from pathlib import Path

import pytest

RECORDINGS = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if RECORDINGS.is_dir():
        return
    skip = pytest.mark.skip(reason="the measured recordings are not here: no folder ../shared/data beside the checkout")
    for item in items:
        if item.get_closest_marker("recordings"):
            item.add_marker(skip)
