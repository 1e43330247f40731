"""Plain laws, at some places or at all and the odd one out, instead of a law with values of its own at each."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nfc_gym.measured.sparser import odd_one_out, sparser
from nfc_gym.physics.effects import FAMILIES
from nfc_gym.physics.effects.each import each

GAIN = FAMILIES["gain"]


def asked(places: str, values: list[float], total: float, pool: list[str]) -> tuple[Any, list]:
    """What becomes of a law with those values where two laws would reach a total, and it 100; and the tries."""
    law, tried = each([GAIN((p,)) for p in places]), []

    def enter(effects: list, thetas: list) -> Any:
        tried.append(([e.id for e in effects], np.concatenate(thetas).tolist()))
        return SimpleNamespace(total=total)

    yes = lambda *_: True  # noqa: E731
    without = SimpleNamespace(enter_at=enter, judge=lambda fitted: SimpleNamespace(total=100.0), believed=yes)
    plant = SimpleNamespace(effects=[law], split=lambda x: (np.zeros(0), [x]))
    arena: Any = SimpleNamespace(
        current=SimpleNamespace(plant=plant, x=np.array(values)), without=lambda effect: without
    )
    return sparser(arena, [GAIN(tuple(p.split("+"))) for p in pool], 0.02), tried


@pytest.mark.parametrize("total", [101.0, 99.0])
def test_two_laws_stand_for_many_values_where_they_are_worth_more(total: float) -> None:
    found, tried = asked("abcd", [1.04, 1.01, 1.04, 1.05], total, ["a", "b", "c", "d", "a+b+c+d"])
    assert [ids for ids, _ in tried] == [["gain:a+b+c+d", "gain:b"]]
    assert tried[0][1] == pytest.approx([1.04, 0.97])
    assert (found is not None and found[0].id == "gain:a+b+c+d:each" and found[1].total == total) == (total > 100)


def test_two_places_need_two_numbers_anyway_and_what_may_not_be_named_is_not_tried() -> None:
    assert asked("ab", [1.05, 1.1], 200.0, ["a", "b", "a+b"]) == (None, [])
    assert asked("ab", [1.0, 1.1], 200.0, ["a", "a+b"]) == (None, [])
    assert asked("abc", [1.0, 1.1, 1.0], 200.0, ["a", "c", "a+b+c"]) == (None, [])


def test_a_law_at_some_places_is_tried_first_and_is_the_one_that_comes_nearest() -> None:
    pool = ["a", "b", "c", "d", "a+b", "c+d", "a+b+c+d", "c+d+e"]
    found, tried = asked("abcd", [1.0, 1.002, 1.1, 1.098], 101.0, pool)
    assert tried == [(["gain:c+d"], [pytest.approx(1.099)])]
    assert found is not None
    assert found[1].total == 101
    _, tried = asked("abcd", [1.0, 1.002, 1.1, 1.098], 99.0, pool)
    assert [ids for ids, _ in tried] == [["gain:c+d"], ["gain:a+b+c+d", "gain:a"]]


@pytest.mark.parametrize("places", ["ab", "abc"])
def test_one_place_stands_for_many_where_the_others_have_nothing(places: str) -> None:
    values = [1.003, 0.8, 0.998][: len(places)]
    found, tried = asked(places, values, 101.0, [*places, "+".join(places)])
    assert tried == [(["gain:b"], [pytest.approx(0.8)])]
    assert found is not None
    assert found[0].id.endswith(":each")


def test_the_odd_one_out_leaves_the_others_alike() -> None:
    assert odd_one_out(np.array([[1.0, 5.0], [1.1, 5.1], [3.0, 5.3]])) == 2
    assert odd_one_out(np.array([[1.0, 0.0], [1.0, 0.0], [1.0, 9.0]])) == 2
