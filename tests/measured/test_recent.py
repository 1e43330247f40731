"""What was asked last is not worked out again, and what was asked long ago makes room."""

import numpy as np
import pytest

from nfc_gym.measured.recent import Recent


def test_the_latest_answers_are_kept_up_to_so_many_bytes() -> None:
    asked: list[str] = []
    recent = Recent(most=3 * 80)  # bytes: three of ten numbers

    def ask(name: str) -> np.ndarray:
        return recent(name, lambda: asked.append(name) or np.full(10, float(ord(name))))

    for name in "abca":
        assert (ask(name) == ord(name)).all()
    assert asked == ["a", "b", "c"]
    ask("d")  # in place of b, which was not asked for longest
    ask("a")
    ask("b")
    assert asked == ["a", "b", "c", "d", "b"]
    assert recent.size == 240


def test_an_answer_larger_than_all_that_may_be_kept_is_given_and_forgotten() -> None:
    recent = Recent(most=100)
    assert recent("large", lambda: np.ones(100)).sum() == 100
    assert recent.size == 0
    assert recent("large", lambda: np.zeros(100)).sum() == 0


def test_nobody_writes_into_an_answer_that_others_will_get() -> None:
    with pytest.raises(ValueError, match="read-only"):
        Recent(100)("ones", lambda: np.ones(3))[0] = 2
