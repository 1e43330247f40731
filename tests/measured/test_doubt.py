"""A claim must lead its rivals by more than it leaves over."""

import pytest
from hinge import DRY, FRICTION, SPRING, arena, pool

from nfc_gym.measured import doubt
from nfc_gym.measured.arena import Arena
from nfc_gym.measured.doubt import doubted
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
    monkeypatch.setattr(doubt, "_share", lambda bare, fitted: shares[at_work(fitted)])
    assert doubted(contest, [FIRST], rivals()) == ({"coulomb:hinge": list(alike)} if alike else {})


def test_the_cause_takes_away_what_its_rivals_cannot(contest: Arena) -> None:
    bare = contest.without(contest.current.plant.effects[0])
    assert doubt._share(bare, contest.current) > 0.9
    assert doubt._share(bare, bare.current) == pytest.approx(0.0, abs=0.01)
    assert doubted(contest, [FIRST], rivals()) == {}


def test_what_no_round_accepted_has_no_rivals(contest: Arena) -> None:
    assert doubted(contest, [Round([], 0.0, FIRST.ranking)], rivals()) == {}
