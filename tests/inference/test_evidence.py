"""Windows as evidence: what they multiply to, how much many of them count for, and what one alone cannot do."""

import numpy as np
import pytest

from nfc_gym.core import InputError
from nfc_gym.inference.evidence import EFFECTIVE, STRAY, combined, shares_of

SHARES = np.array([0.5, 0.3, 0.2])


def test_a_window_that_says_nothing_leaves_the_shares() -> None:
    assert combined(np.tile(SHARES, (5, 1)), SHARES) == pytest.approx(SHARES)


def test_few_windows_multiply() -> None:
    told = np.array([[0.2, 0.7, 0.1], [0.3, 0.3, 0.4]])
    each = (1 - STRAY) * told + STRAY * SHARES
    by_hand = SHARES * (each / SHARES).prod(0)
    assert combined(told, SHARES) == pytest.approx(by_hand / by_hand.sum())


def test_many_windows_count_for_a_few() -> None:
    told = np.array([[0.3, 0.6, 0.1]])
    few, many = (combined(np.repeat(told, n, 0), SHARES) for n in (int(EFFECTIVE), 500))
    assert many == pytest.approx(few)
    assert few[1] > combined(told, SHARES)[1]


def test_one_window_excludes_nothing() -> None:
    sure, doubt = np.array([[0.01, 0.98, 0.01]]), np.array([[1.0, 0.0, 0.0]])
    both = combined(np.concatenate([np.repeat(sure, 4, 0), doubt]), SHARES)
    assert both.argmax() == 1


def test_a_family_that_no_window_was_trained_with_stays_out() -> None:
    found = combined(np.array([[0.5, 0.2, 0.3]]), np.array([0.6, 0.4, 0.0]))
    assert found[2] == 0
    assert found.sum() == pytest.approx(1)


@pytest.mark.parametrize("told", [np.zeros((0, 3)), np.ones((4, 2)), np.ones(3)])
def test_other_shapes_are_refused(told: np.ndarray) -> None:
    with pytest.raises(InputError, match="one window or more"):
        combined(told, SHARES)


def test_shares_come_from_the_notes() -> None:
    families = ("none", "wind", "payload")
    assert shares_of(families, {"shares": [0.2, 0.3, 0.5]}) == pytest.approx([0.2, 0.3, 0.5])
    assert shares_of(families, {}) == pytest.approx([0.5, 0.25, 0.25])
