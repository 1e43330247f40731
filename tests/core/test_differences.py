"""What two descriptions of a run disagree in: keys of either, in words."""

from typing import Any

import pytest

from nfc_gym.core.differences import differences

KEPT = {"seed": 0, "task": None, "names": ["a"], "settings": {"difficulty": 0.9, "terrain_pool": 2}}


@pytest.mark.parametrize(
    ("now", "told"),
    [
        pytest.param({}, [], id="the same"),
        pytest.param({"seed": 1}, ["seed 0, now 1"], id="another value"),
        pytest.param({"names": ["b"]}, ["another names"], id="a list"),
        pytest.param({"names": None}, ["another names"], id="no list"),
        pytest.param({"task": "figure8"}, ["task not given, now 'figure8'"], id="a value where none was"),
        pytest.param({"settings": {"terrain_pool": 2}}, ["difficulty 0.9, now not given"], id="a key left out"),
        pytest.param({"settings": {}}, ["difficulty 0.9, now not given", "terrain_pool 2, now not given"], id="all"),
        pytest.param({"settings": 3}, ["another settings"], id="no mapping"),
        pytest.param({"home": None, "signals": {}}, [], id="a key of later code, at its default"),
        pytest.param({"signals": {"exo:supply": 24.0}}, ["exo:supply not given, now 24.0"], id="a key of later code"),
    ],
)
def test_keys_of_either_are_compared(now: dict[str, Any], told: list[str]) -> None:
    assert list(differences(KEPT, KEPT | now)) == told


def test_what_is_left_out_altogether_counts_too() -> None:
    now = {k: v for k, v in KEPT.items() if k in ("names", "settings")}
    assert list(differences(KEPT, now)) == ["seed 0, now not given"]
    del now["settings"]
    assert list(differences(KEPT, now))[1:] == ["difficulty 0.9, now not given", "terrain_pool 2, now not given"]
