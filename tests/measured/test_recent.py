"""What was asked last is not worked out again, and what was asked long ago makes room."""

import numpy as np
import pytest

from nfc_gym.measured.recent import Blocks, Recent


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


def test_blocks_that_were_asked_are_not_asked_again_with_the_rest() -> None:
    asked: list[tuple[list[int], list[int]]] = []

    def answer(rows: np.ndarray, blocks: np.ndarray) -> np.ndarray:
        asked.append((rows.tolist(), blocks.tolist()))
        return (10.0 * rows[:, None] + some[blocks])[..., None]

    recent, every = Blocks(most=10**6, size=6), np.arange(6)
    some = np.array([4, 1])
    assert recent(["a", "b"], some, answer)[..., 0].tolist() == [[4, 1], [14, 11]]
    some = every
    found = recent(["a", "b", "c"], every, answer)[..., 0]
    assert found.tolist() == [[0, 1, 2, 3, 4, 5], [10, 11, 12, 13, 14, 15], [20, 21, 22, 23, 24, 25]]
    assert asked == [([0, 1], [0, 1]), ([0, 1], [0, 2, 3, 5]), ([2], [0, 1, 2, 3, 4, 5])]
    with pytest.raises(ValueError, match="read-only"):
        recent(["a"], every, answer)[0] = 0
    assert len(asked) == 3


def test_blocks_keep_no_more_than_they_may() -> None:
    asked: list[int] = []

    def answer(rows: np.ndarray, blocks: np.ndarray) -> np.ndarray:
        asked.append(len(rows))
        return np.zeros((len(rows), len(blocks), 1))

    recent, every = Blocks(most=2 * 5 * 8, size=5), np.arange(5)  # bytes: two rows of five numbers
    for question in "abca":
        recent([question], every, answer)
    assert asked == [1, 1, 1, 1]
    recent(["c", "a"], every, answer)
    assert asked == [1, 1, 1, 1]
