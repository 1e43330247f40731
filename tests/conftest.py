"""Shared by all tests: the recordings' folder, a clear skip where it is absent, and no test that times itself."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# How long an example takes depends on what else the machine does: the time of a test is no property of the code.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")

RECORDINGS = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if RECORDINGS.is_dir():
        return
    skip = pytest.mark.skip(reason="the measured recordings are not here: no folder ../shared/data beside the checkout")
    for item in items:
        if item.get_closest_marker("recordings"):
            item.add_marker(skip)
