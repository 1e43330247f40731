"""Pairs of laws that promise most together, and two laws in place of a class that is too wide."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nfc_gym.measured.fit import Fit
from nfc_gym.measured.pairing import promising
from nfc_gym.measured.rounds import Contest


def model(white: list[float], family: str = "") -> Any:
    effects = [SimpleNamespace(family=family)] if family else []
    plant: Any = SimpleNamespace(white=np.array(white)[None, None], effects=effects)
    return SimpleNamespace(fitted=Fit(plant, np.zeros(1), plant.white[0], np.zeros((1, len(white), 0))))


def arena(white: list[float]) -> Any:
    problem = SimpleNamespace(residual=lambda plant, x: plant.white)
    return SimpleNamespace(
        fit_data=SimpleNamespace(problem=problem),
        under=SimpleNamespace(whiten=lambda residual: residual),
        current=model(white).fitted,
        new=lambda j: j.fitted.plant.effects,
    )


def test_two_names_of_one_thing_are_no_promising_pair() -> None:
    """Two laws that lead do the same; a third that gains less does something else."""
    lag, shift, gain, payload = (
        model([1.0, 1.0, 0.2, 0.0], "lag"),
        model([0.1, 0.1, 1.0, 0.0], "com_shift"),
        model([0.0, 0.2, 1.0, 0.1], "gain"),
        model([0.2, 0.0, 1.0, 0.1], "payload"),
    )
    pairs = promising(arena([1.0, 1.0, 1.0, 0.0]), [shift, gain, payload, lag], 1)
    assert [tuple(map(id, pair)) for pair in pairs] == [(id(shift), id(lag))]


def test_a_pair_has_two_families_and_does_not_undo_itself() -> None:
    """One that must be taken back for another to help promises nothing with it."""
    one, same, back, other = (
        model([0.5, 1.2, 1.0], "lag"),
        model([1.0, 0.0, 1.0], "lag"),
        model([1.0, 1.5, 1.0], "gain"),
        model([1.0, 1.0, 0.9], "wind"),
    )
    pairs = promising(arena([1.0, 1.0, 1.0]), [one, same, back, other], 1)
    assert [tuple(map(id, pair)) for pair in pairs] == [(id(same), id(other))]
    assert len(promising(arena([1.0, 1.0, 1.0]), [one, same, back], 3)) == 2


@pytest.mark.parametrize(
    ("leftover", "total", "found"),
    [(0.05, 200.0, True), (0.05, 120.0, False), (0.01, 200.0, False), (0.5, 200.0, False)],
    ids=["much better", "hardly better", "nothing left", "tried before"],
)
def test_two_laws_where_too_many_do_alike(leftover: float, total: float, found: bool) -> None:
    both: Any = SimpleNamespace(total=total)
    at: Any = SimpleNamespace(leftover=leftover, fit_data=SimpleNamespace(problem=SimpleNamespace(rough=False)))
    contest: Any = Contest(at, SimpleNamespace(), [], 8, 0.02)  # pyright: ignore[reportArgumentType]
    contest._pairs, contest._believed, contest._simplest = lambda *_: [both], lambda j: True, lambda js: js[0]
    assert contest._instead(SimpleNamespace(total=100.0), [], []) is (both if found else None)
