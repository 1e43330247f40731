"""How far slopes can follow: contact ends it, length alone does not."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nfc_gym.measured.foresight import bent, followed
from nfc_gym.measured.problem import Columns, Problem

HORIZONS = np.array([0.1, 0.2, 0.4, 0.8])


class Landing(Problem):
    """Errors that grow in proportion to psi, and at some horizons are thrown by it to anywhere instead."""

    def __init__(self, thrown: tuple[bool, ...], rough: bool = True, blocks: int = 20) -> None:
        self.thrown, self.rough = np.array(thrown), rough
        self.mask = np.ones((blocks, len(HORIZONS)), bool)
        self.log_of, self.time_of, self.names = np.zeros(blocks, int), np.arange(float(blocks)), ("log",)
        self.columns = Columns(("a",) * 4, ("1",) * 4, HORIZONS, ("joint:j",) * 4)

    def residual(self, plant: Any, x: np.ndarray) -> np.ndarray:
        block = np.arange(1.0, len(self) + 1)[None, :, None]
        slope = block * HORIZONS * (x[:, :1] + 2 * x[:, 1:])[:, None]
        return np.where(self.thrown, np.sin(1e5 * slope), slope)

    def covariance(self, plant, x): ...  # type: ignore[override]

    def take(self, index): ...  # type: ignore[override]

    def synthetic(self, plant, x, rng): ...  # type: ignore[override]


def model(free: bool = True) -> Any:
    space = SimpleNamespace(low=np.full(2, -2.0), high=np.full(2, 2.0), free=np.full(2, free))
    same = lambda x: x  # noqa: E731
    return SimpleNamespace(space=space, effects=(), null=np.zeros(2), chart=same, unchart=same, size=2)


def test_a_straight_line_is_not_bent_and_noise_is_all_bent() -> None:
    found = bent(Landing((False, False, True, True)), model(), np.array([0.3, 0.1]))
    assert found[:2] == pytest.approx(0.0, abs=1e-9)
    assert (found[2:] > 0.6).all()


@pytest.mark.parametrize(
    ("thrown", "kept"),
    [
        ((False, False, False, False), 4),
        ((False, False, False, True), 3),
        ((False, False, True, True), 2),
        ((False, True, True, True), 2),  # one horizon would leave nothing to compare
        ((True, True, True, True), 4),  # shorter segments would be no smoother
    ],
)
def test_what_slopes_can_follow_is_kept(thrown: tuple[bool, ...], kept: int) -> None:
    assert followed(Landing(thrown), model(), np.array([0.3, 0.1])) == kept


def test_all_is_kept_where_nothing_touches_or_no_psi_is_free() -> None:
    thrown = (False, False, True, True)
    assert followed(Landing(thrown, rough=False), model(), np.zeros(2)) == 4
    assert followed(Landing(thrown), model(free=False), np.zeros(2)) == 4
