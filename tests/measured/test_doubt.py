"""A claim must lead its rivals by more than it leaves over."""

import numpy as np
import pytest
from hinge import DRY, FRICTION, SPRING, arena, pool

from nfc_gym.measured import doubt
from nfc_gym.measured.arena import Arena
from nfc_gym.measured.doubt import doubted
from nfc_gym.measured.metric import taken
from nfc_gym.measured.ranking import Round
from nfc_gym.physics.effects import build

RIVALS = ("damping_poly:hinge", "armature:hinge", "external_force:hinge")
FIRST = Round(["coulomb:hinge"], 0.5, [{"id": i} for i in ("coulomb:hinge", *RIVALS, "damping_poly:hinge + x:y")])


@pytest.fixture(scope="module")
def contest() -> Arena:
    return arena(FRICTION, [build(*DRY), build(*SPRING)])


def rivals() -> list:
    other = [("armature", "hinge", {"inertia": 1e-4}), ("external_force", "hinge", {"force": 0.1})]
    return [*pool(), *(build(*e)[0] for e in other)]


@pytest.mark.parametrize(
    ("own", "others", "alike"),
    [
        (0.8, (0.7, 0.65, 0.2), RIVALS[:2]),
        (0.8, (0.7, 0.55, 0.2), ()),  # one rival: a class of two
        (0.95, (0.7, 0.7, 0.7), ()),
        (0.5, (0.0, 0.1, -1.0), RIVALS[:2]),
    ],
)
def test_a_claim_that_leaves_more_than_it_leads_by_is_doubted(
    contest: Arena, monkeypatch: pytest.MonkeyPatch, own: float, others: tuple[float, ...], alike: tuple[str, ...]
) -> None:
    shares = {"coulomb:hinge": own, **dict(zip(RIVALS, others, strict=True))}
    at_work = lambda fitted: next(e.id for e in fitted.plant.effects if e.id in shares)  # noqa: E731
    left = lambda fitted: np.array([1 - shares[at_work(fitted)] if fitted.plant.effects[1:] else 1.0])  # noqa: E731
    monkeypatch.setattr(doubt, "_errors", lambda bare, fitted: left(fitted))
    monkeypatch.setattr(doubt, "_noise", lambda bare: np.zeros(1))
    assert doubted(contest, [FIRST], rivals()) == ({"coulomb:hinge": list(alike)} if alike else {})


def test_the_cause_takes_away_what_its_rivals_cannot(contest: Arena) -> None:
    bare = contest.without(contest.current.plant.effects[0])
    before, own = (doubt._errors(bare, fitted) for fitted in (bare.current, contest.current))
    assert taken(before, own, doubt._noise(bare)) > 0.9
    assert doubted(contest, [FIRST], rivals()) == {}


@pytest.mark.parametrize(
    ("own", "other", "nearly"),
    [
        ((0.001, 1.0), (0.02, 1.0), False),  # nineteen thousandths apart, one left: the rest is out of reach of both
        ((0.001, 1.0), (0.0015, 1.0), True),
        ((0.001, 1.0), (0.003, 0.5), True),  # the rival does something there
        ((0.02, 0.3), (0.03, 0.4), True),
    ],
)
def test_what_neither_changes_tells_nothing_between_them(
    own: tuple[float, ...], other: tuple[float, ...], nearly: bool
) -> None:
    assert doubt._nearly(np.ones(2), np.array(own), np.array(other), np.full(2, 1e-6)) == nearly


def test_what_no_round_accepted_has_no_rivals(contest: Arena) -> None:
    assert doubted(contest, [Round([], 0.0, FIRST.ranking)], rivals()) == {}
