"""Pairs of laws that promise most together, and two laws in place of a class that is too wide."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nfc_gym.measured.fit import Fit
from nfc_gym.measured.pairing import promising
from nfc_gym.measured.rounds import Contest


def model(white: list[float], family: str = "") -> Any:
    effects = [SimpleNamespace(family=family, params=(None,))] if family else []
    plant: Any = SimpleNamespace(white=np.array(white)[None, None], effects=effects)
    return SimpleNamespace(fitted=Fit(plant, np.zeros(1), plant.white[0], np.zeros((1, len(white), 0))))


def arena(white: list[float], price: float = 0.0) -> Any:
    problem = SimpleNamespace(residual=lambda plant, x: plant.white)
    return SimpleNamespace(
        fit_data=SimpleNamespace(problem=problem),
        under=SimpleNamespace(whiten=lambda residual: residual),
        current=model(white).fitted,
        new=lambda j: j.fitted.plant.effects,
        on_both=lambda gain: gain,
        cost=lambda parameters: parameters * price,
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
    assert len(promising(arena([1.0, 1.0, 1.0]), [one, same, back], 3)) == 0
    assert promising(arena([1.0, 1.0, 1.0]), [one], 3) == []


@pytest.mark.parametrize(("price", "tried"), [(0.5, True), (5.0, False)])
def test_a_pair_must_promise_some_of_what_the_second_law_costs(price: float, tried: bool) -> None:
    """The second law takes a loss of one away beside the first: more than a quarter of 0.5, less than one of 5."""
    one, other = model([0.0, 0.0, 1.0], "lag"), model([1.0, 1.0, 0.0], "wind")
    assert bool(promising(arena([1.0, 1.0, 1.0], price), [one, other], 3)) == tried


def standing(leftover: float, before: float = 0.0) -> Any:
    """An arena in which all is plausible whose total is no more than 1000; what a model leaves is its own to say."""
    data, current = SimpleNamespace(problem=SimpleNamespace(rough=False)), SimpleNamespace(left=before)
    return SimpleNamespace(
        leftover=leftover,
        fit_data=data,
        current=current,
        leaves=lambda fitted: fitted.left,
        plausible=lambda j: j.total <= 1000.0,
    )


@pytest.mark.parametrize(
    ("totals", "trusted", "found"),
    [([100.0, 90.0], [90.0], True), ([100.0, 90.0], [], False), ([5000.0, 90.0], [], True)],
    ids=["more than what is believed", "hardly more than what is not", "more than all that is plausible"],
)
def test_two_laws_must_gain_clearly_more_than_one(totals: list[float], trusted: list[float], found: bool) -> None:
    """Where none is believed too: stand-ins for what the library lacks gain a little more by twos."""
    both: Any = SimpleNamespace(total=120.0, fitted=SimpleNamespace(left=0.01))
    contest: Any = Contest(standing(0.2), SimpleNamespace(), [], 8, 0.02)  # pyright: ignore[reportArgumentType]
    contest._believed = lambda j: True
    alone, believed = ([SimpleNamespace(total=t) for t in some] for some in (totals, trusted))
    assert contest._together([both], believed, alone) == ([both] if found else [])


@pytest.mark.parametrize(
    ("before", "after", "found"),
    [(0.3, 0.05, True), (0.3, 0.2, False), (2.0, 0.9, True), (2.0, 1.5, False)],
    ids=["little", "most of what was little", "less than half of much", "most of much"],
)
def test_two_laws_must_leave_little_or_half(before: float, after: float, found: bool) -> None:
    both: Any = SimpleNamespace(total=500.0, fitted=SimpleNamespace(left=after))
    contest: Any = Contest(standing(0.2, before), SimpleNamespace(), [], 8, 0.02)  # pyright: ignore[reportArgumentType]
    contest._believed = lambda j: True
    assert contest._together([both], [], []) == ([both] if found else [])


@pytest.mark.parametrize(
    ("leftover", "total", "found"),
    [(0.05, 200.0, True), (0.05, 120.0, False), (0.01, 200.0, False), (0.5, 200.0, False)],
    ids=["much better", "hardly better", "nothing left", "tried before"],
)
def test_two_laws_where_too_many_do_alike(
    leftover: float, total: float, found: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    both: Any = SimpleNamespace(total=total, fitted=SimpleNamespace(left=0.01))
    at: Any = standing(leftover)
    contest: Any = Contest(at, SimpleNamespace(), [], 8, 0.02)  # pyright: ignore[reportArgumentType]
    monkeypatch.setattr(Contest, "_choice", SimpleNamespace(simplest=lambda judged: judged[0]))
    contest._pairs, contest._believed = lambda *_: [both], lambda j: True
    assert contest._instead(SimpleNamespace(total=100.0), [], []) is (both if found else None)
