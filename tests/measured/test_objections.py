"""Tests of why a candidate is not believed."""

from types import SimpleNamespace
from typing import Any

import pytest

from nfc_gym.measured.yardstick import Yardstick

CHECKS = ("sure", "worth", "plausible", "told_apart")


def yardstick(rough: bool, failing: str) -> Any:
    """A yardstick of which one check fails."""
    out: Any = object.__new__(Yardstick)
    out.fit_data = SimpleNamespace(problem=SimpleNamespace(rough=rough))
    for name in CHECKS:
        setattr(out, name, lambda *_, answer=name != failing: answer)
    return out


@pytest.mark.parametrize(
    ("failing", "said"),
    [
        ("", ""),
        ("sure", "gains no more on unseen logs than chance"),
        ("worth", "gains less than its numbers cost and 2 % of what is left"),
        ("plausible", "ends at the edge of what is plausible"),
        ("told_apart", "does what the other parameters could do together"),
    ],
)
def test_it_says_which_check_fails(failing: str, said: str) -> None:
    asked = yardstick(True, failing)
    assert asked.objection(None, 0.02) == said
    assert asked.believed(None, 0.02) == (not failing)


def test_where_nothing_touches_a_gain_is_the_candidates_own() -> None:
    """A friction that bends with speed hardly differs from a straight one in its slopes."""
    assert yardstick(False, "told_apart").believed(None, 0.02)
    assert not yardstick(False, "sure").believed(None, 0.02)
