"""What becomes of effects that were found: causes, or what merely comes nearest."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nfc_gym.measured.outcome import _judge
from nfc_gym.measured.verdict import nought

ROWS: list[dict[str, Any]] = [{"id": "wind:base", "share_of_excess": 0.1}, {"id": "law_power:base"}]


def judged(
    chi2: float,
    after: float,
    rows: list[dict[str, Any]] = ROWS[:1],
    misshapen: dict[str, str] | None = None,
    gain: tuple[float, float] = (0.5, 0.9),
    generic: str | None = None,
    nought: tuple[str, ...] = (),
    **doubted: list[str],
) -> Any:
    """Of models that leave `after` beyond a noise of 1, where calibration leaves 5, with this chi-squared."""
    row = {"calibrated": [5.0], "extended": [after], "noise_floor": [1.0]}
    v: Any = SimpleNamespace(null=np.ones(6), shares=np.ones((6, 1)), chi2=lambda stage: chi2)
    doubts = {f"{family}:base": ids for family, ids in doubted.items()}
    found: Any = SimpleNamespace(generic=generic, doubted=doubts, misshapen=misshapen or {})
    return _judge(v, rows, {"law_power:base"}, found, {"groups": {"angle": row}}, gain, nought)


@pytest.mark.parametrize(("after", "claimed"), [(np.sqrt(12.5), True), (np.sqrt(13.5), False)])
def test_a_cause_takes_away_half_of_what_is_missing(after: float, claimed: bool) -> None:
    out = judged(3.0, after)
    assert out.verdict == ("partly explained" if claimed else "unexplained")
    assert out.claimed == (ROWS[:1] if claimed else [])
    assert out.weak == ([] if claimed else [ROWS[0] | {"nearest": True, "alike": []}])


def test_where_nothing_remains_what_was_found_is_the_cause() -> None:
    out = judged(1.0, 4.9)
    assert (out.verdict, out.claimed, out.weak) == ("explained", ROWS[:1], [])


def test_where_nothing_is_seen_to_be_missing_what_makes_no_sure_difference_is_no_cause() -> None:
    out = judged(1.0, 4.9, gain=(0.75, 1.0006))
    assert (out.verdict, out.claimed) == ("nothing missing", [])
    assert out.weak == [ROWS[0] | {"nearest": True, "alike": []}]
    law = judged(1.0, 4.9, ROWS[1:], gain=(0.75, 1.0006))
    assert (law.verdict, law.laws) == ("nothing missing", ROWS[1:])
    assert judged(1.0, 4.9, [], gain=(0.75, 1.0006), generic="generic_memory:base").verdict == "nothing missing"
    assert judged(1.05, 4.9, gain=(0.75, 1.0006)).claimed == judged(1.0, 4.9, gain=(0.6, 0.99)).claimed == ROWS[:1]


def test_where_less_is_left_than_noise_would_leave_a_claim_must_mend_a_tenth_of_it() -> None:
    assert judged(0.2, 4.9, gain=(0.85, 0.95)).claimed == []
    assert judged(0.2, 4.9, gain=(0.6, 0.85)).claimed == ROWS[:1]


def test_one_guess_among_several_is_no_cause() -> None:
    alike = ["gain:rotor", "payload:base"]
    beside = {"id": "delay:rotor", "share_of_excess": 0.6}
    out = judged(3.0, 1.5, [*ROWS[:1], beside], wind=alike)
    assert (out.verdict, out.claimed) == ("partly explained", [beside])
    assert out.weak == [ROWS[0] | {"nearest": True, "alike": alike}]
    assert out.share == 0.1  # beside a cause: what comes back when it alone is taken out
    alone = judged(3.0, 1.5, wind=alike)
    assert (alone.verdict, alone.share) == ("unexplained", alone.taken)
    assert judged(1.0, 1.0, wind=alike).claimed == ROWS[:1]


def test_what_may_have_no_size_is_no_cause_where_something_remains() -> None:
    beside = {"id": "lag:rotor", "share_of_excess": 0.0004}
    out = judged(3.0, 1.5, [*ROWS[:1], beside], nought=("lag:rotor",))
    assert (out.verdict, out.claimed) == ("partly explained", ROWS[:1])
    assert out.weak == [beside | {"nearest": True, "alike": [], "may_be_none": True}]
    assert judged(3.0, 1.5, nought=("wind:base",)).verdict == "unexplained"
    assert judged(1.0, 1.0, nought=("wind:base",)).claimed == ROWS[:1]


@pytest.mark.parametrize(
    ("low", "high", "none"),
    [
        ([0.0, -0.1, -0.2], [0.03, 0.1, 0.2], {"lag:m", "external_force:base"}),
        ([0.001, -0.1, 0.1], [0.03, 0.1, 0.2], set()),  # along one axis the push is sure
        ([0.001, -0.1, -0.2], [0.03, 0.1, 0.2], {"external_force:base"}),
    ],
)
def test_an_effect_of_which_every_size_may_be_none(low: list[float], high: list[float], none: set[str]) -> None:
    def law(name: str, *shapes: bool) -> Any:
        params = [SimpleNamespace(shape=shape, given=False) for shape in shapes]
        return SimpleNamespace(id=name, params=params, null=np.zeros(len(shapes)))

    effects = [law("lag:m", False), law("external_force:base", False, False, True)]
    fitted: Any = SimpleNamespace(plant=SimpleNamespace(space=("mass",), effects=effects))
    within = np.array([[1.0, *low, 5.0], [2.0, *high, 6.0]])  # psi, the sizes, and a shape that none of this is about
    assert nought(fitted, within) == none


def test_what_is_small_beside_guesses_is_no_cause() -> None:
    small = {"id": "delay:rotor", "share_of_excess": 0.4}
    out = judged(3.0, 1.5, [*ROWS[:1], small], wind=["gain:rotor", "payload:base"])
    assert (out.verdict, out.claimed) == ("unexplained", [])
    assert [(r["id"], r["alike"]) for r in out.weak] == [
        ("wind:base", ["gain:rotor", "payload:base"]),
        ("delay:rotor", []),
    ]
    both = [small, *ROWS[:1]]
    assert judged(3.0, 1.5, both).claimed == both, "without guesses it may be one of several"


def test_what_mends_nothing_on_unseen_logs_is_no_cause() -> None:
    one, other = ({"id": i, "share_of_excess": 0.2} for i in ("dead_zone:motor", "delay:motor"))
    idle = {"id": "stribeck:swing", "share_of_excess": 0.0}
    out = judged(3.0, 1.5, [one, other, idle])
    assert (out.verdict, out.claimed) == ("partly explained", [one, other])
    assert out.weak == [idle | {"nearest": True, "alike": []}]
    assert judged(3.0, 1.5, [idle]).verdict == "unexplained"
    assert judged(1.0, 1.0, [idle]).claimed == [idle], "nothing remains that another law could have left"


def test_a_law_of_another_form_is_no_cause() -> None:
    of = {"spring_offset:knee": "generic_memory:knee"}
    spring, friction = ({"id": i, "share_of_excess": 0.6} for i in (*of, "coulomb:hip"))
    out = judged(3.0, 1.5, [spring, friction], of)
    assert (out.verdict, out.claimed) == ("partly explained", [friction])
    assert out.weak == [spring | {"nearest": True, "alike": [], "mended_by": "generic_memory:knee"}]
    assert judged(3.0, 1.5, [spring], of).verdict == "unexplained"
    assert judged(1.0, 1.0, [spring], of).claimed == [spring], "nothing remains that a form could be told by"


def test_a_law_in_words_is_a_proposal_either_way() -> None:
    few, much = judged(3.0, 4.9, ROWS), judged(3.0, 1.0, ROWS)
    assert ([r["id"] for r in few.weak], few.laws, few.claimed) == (["wind:base"], ROWS[1:], [])
    assert (much.claimed, much.laws, much.weak) == (ROWS[:1], ROWS[1:], [])
