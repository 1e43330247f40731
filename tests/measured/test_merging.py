"""One law in place of two: of the laws that may stand there the one that promises most, where it is worth more."""

from types import SimpleNamespace
from typing import Any

import pytest

from nfc_gym.measured import merging
from nfc_gym.physics.effects import FAMILIES

SHIFT, GAIN = FAMILIES["com_shift"](("base",)), FAMILIES["gain"](("left", "right"))
LOAD, INERTIA, WIND = (FAMILIES[f](("base",)) for f in ("payload", "inertia", "wind"))
ELSEWHERE = FAMILIES["payload"](("arm",))


def asked(
    monkeypatch: pytest.MonkeyPatch, total: float, pool: list, believed: bool = True, two: tuple = (SHIFT, GAIN)
) -> tuple[Any, list[str], list[str]]:
    """What becomes of two laws that are worth 100, and the ids that were screened and entered."""
    screened: list[str] = []
    entered: list[str] = []

    class Screen:
        def __init__(self, problem: object, under: object, current: Any) -> None:
            assert current.plant.effects == []  # in place of both

        def try_one(self, effect: Any) -> Any:
            screened.append(effect.id)
            return SimpleNamespace(effect=effect, gain=float(len(effect.params)))

    def enter(picks: list) -> Any:
        entered.extend(p.effect.id for p in picks)
        return SimpleNamespace(total=total)

    def arena(effects: list) -> Any:
        plant = SimpleNamespace(effects=effects)
        return SimpleNamespace(
            current=SimpleNamespace(plant=plant), under=None, fit_data=SimpleNamespace(problem=None),
            without=lambda gone: arena([e for e in effects if e is not gone]), enter=enter,
            judge=lambda fitted: SimpleNamespace(total=100.0), believed=lambda j, share: believed,
        )  # fmt: skip

    monkeypatch.setattr(merging, "Screen", Screen)
    return merging.merged(arena(list(two)), pool, 0.02), screened, entered


@pytest.mark.parametrize("total", [101.0, 99.0])
def test_a_load_stands_for_a_shift_and_a_gain_where_it_is_worth_more(
    monkeypatch: pytest.MonkeyPatch, total: float
) -> None:
    found, screened, entered = asked(monkeypatch, total, [SHIFT, GAIN, LOAD, INERTIA, WIND, ELSEWHERE])
    assert LOAD.id in screened
    assert entered == [LOAD.id]  # it has most numbers here, and so promises most
    assert (found is not None and found[0] == (SHIFT, GAIN) and found[1].total == total) == (total > 100)


def test_what_is_not_believed_takes_no_place(monkeypatch: pytest.MonkeyPatch) -> None:
    assert asked(monkeypatch, 200.0, [LOAD], believed=False) == (None, [LOAD.id], [LOAD.id])


def test_a_load_stands_for_a_shift_and_what_mends_it_as_a_load_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    found, screened, _ = asked(monkeypatch, 101.0, [LOAD, ELSEWHERE, SHIFT], two=(SHIFT, ELSEWHERE))
    assert found is not None
    assert screened == [LOAD.id]


def test_another_place_too_few_numbers_and_what_is_there_already_are_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    few = FAMILIES["gain"](("base",))
    assert asked(monkeypatch, 200.0, [ELSEWHERE, SHIFT, GAIN, few]) == (None, [], [])
