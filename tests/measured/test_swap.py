"""An earlier law gives way to the one that does better beside the others."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hinge import DRY, FRICTION, LAGGING, SCALES, SPRING, VISCOUS, arena, given, pool

from nfc_gym.measured.lookout import Lookout
from nfc_gym.measured.ranking import Round
from nfc_gym.measured.search import Options, Search, State, _met
from nfc_gym.measured.swap import Swap, _picked, join_kin, swapped
from nfc_gym.physics.effects import FAMILIES, build
from nfc_gym.physics.effects.joint import DampingPoly


@pytest.mark.parametrize(
    ("physics", "first", "right"),
    [(FRICTION, VISCOUS, "coulomb:hinge"), (LAGGING, DRY, "damping_poly:hinge"), (FRICTION, DRY, None)],
    ids=["dry for viscous", "viscous for dry", "right from the start"],
)
def test_the_wrong_law_beside_a_right_one_is_exchanged(physics: str, first: tuple, right: str | None) -> None:
    contest = arena(physics, [build(*first), build(*SPRING)])
    lookout = Lookout(contest.fit_data.problem, np.random.default_rng(0), lambda text: None)
    said: list[str] = []
    found = swapped(contest, lookout, pool(), 0.02, said.append)
    if right is None:
        assert found.better is None
        assert not found.alike
        return
    assert found.better is not None
    assert {e.id for e in found.better.plant.effects} == {right, "spring_offset:hinge"}
    assert said == [f"{right} in place of {first[0]}:hinge: together they explain more"]


class Twin(DampingPoly):
    """Damping by another name."""

    family = "twin"


@pytest.mark.parametrize("leads", [True, False], ids=["leads the screening", "does what the law does"])
def test_what_does_as_well_in_an_earlier_laws_place_is_its_equivalent(
    leads: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not leads:
        monkeypatch.setattr("nfc_gym.measured.swap.shortlist", lambda *_: [])
    contest = arena(LAGGING, [build(*VISCOUS), build(*SPRING)])
    lookout = Lookout(contest.fit_data.problem, np.random.default_rng(0), lambda text: None)
    twins = Twin.propose(given(), SCALES)
    found = swapped(contest, lookout, [*pool(), *twins], 0.02, lambda text: None)
    assert found.better is None
    assert found.alike == {"damping_poly:hinge": ["twin:hinge"]}


def test_equivalents_in_the_last_model_join_those_of_the_round(monkeypatch: pytest.MonkeyPatch) -> None:
    """A law that did worse while another was missing may do as well beside it."""
    search: Any = object.__new__(Search)
    search.options, search.lookout, search.named, search.say = Options(), None, [], None
    rounds = [Round(["a:x"], 0.5, equivalents=["b:x"]), Round(["d:x", "e:x"], 0.1), Round([], 0.0)]
    alike = {"a:x": ["b:x", "c:x"], "e:x": ["f:x"]}
    monkeypatch.setattr("nfc_gym.measured.search.swapped", lambda *_: Swap(alike=alike))
    laws = [SimpleNamespace(id=i) for i in ("a:x", "d:x", "e:x")]
    last: Any = SimpleNamespace(current=SimpleNamespace(plant=SimpleNamespace(effects=laws)))
    assert search._exchange(last, rounds) is None
    assert [r.equivalents for r in rounds] == [["b:x", "c:x"], [], []]
    assert [rounds[1].rivals(i) for i in rounds[1].accepted] == [[], ["f:x"]]


def test_what_contains_an_equivalent_that_an_exchange_found_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """The round found the wind beside a slope; the push that it contains does as well in the last model."""
    slope, push, wind = FAMILIES["slope"](("world",)), FAMILIES["external_force"](("b",)), FAMILIES["wind"](("b",))
    search: Any = object.__new__(Search)
    search.options, search.lookout, search.named, search.say = Options(), None, [slope, push, wind], None
    rounds = [Round([slope.id], 0.5, equivalents=[wind.id])]
    monkeypatch.setattr("nfc_gym.measured.search.swapped", lambda *_: Swap(alike={slope.id: [push.id]}))
    last: Any = SimpleNamespace(current=SimpleNamespace(plant=SimpleNamespace(effects=[slope])))
    assert search._exchange(last, rounds) is None
    assert rounds[0].equivalents == [push.id]


@pytest.mark.parametrize(
    ("met", "alike"),
    [((), True), (("damping_poly:aside",), False), (None, True)],
    ids=["nobody", "its other place", "accepted with the first"],
)
def test_the_last_law_meets_its_familys_other_places(met: tuple[str, ...] | None, alike: bool) -> None:
    """A round's shortlist has few of them; all others have met it in its round, if it came alone."""

    class Aside(DampingPoly):
        id = property(lambda self: "damping_poly:aside")  # type: ignore[assignment]

    contest = arena(LAGGING, [build(*SPRING), build(*VISCOUS)])
    lookout = Lookout(contest.fit_data.problem, np.random.default_rng(0), lambda text: None)
    found = swapped(contest, lookout, [*pool(), *Aside.propose(given(), SCALES)], 0.02, lambda text: None, met)
    assert found.better is None
    assert found.alike == ({"damping_poly:hinge": ["damping_poly:aside"]} if alike else {})


def test_a_law_that_stands_alone_met_its_kind_in_its_round() -> None:
    """Nothing has joined it since, and a second look would cost a round's screening in every search that finds one."""
    asked: list[str] = []
    plant = SimpleNamespace(effects=[build(*VISCOUS)[0]])
    contest: Any = SimpleNamespace(current=SimpleNamespace(plant=plant), without=lambda effect: asked.append(effect.id))
    lookout: Any = None
    assert swapped(contest, lookout, pool(), 0.02, lambda text: None) == Swap()
    assert not asked


@pytest.mark.parametrize("left", [False, True])
def test_what_a_law_met_beside_laws_that_have_left_is_asked_anew(left: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A shifted centre of mass came beside two gains, which it made superfluous; a load was fitted beside these."""
    asked: list[Any] = []
    monkeypatch.setattr("nfc_gym.measured.search.swapped", lambda *args: asked.append(args[-1]) or Swap())
    last: Any = SimpleNamespace(plant="two", x=None)
    search: Any = object.__new__(Search)
    search.options, search.lookout, search.named, search.say = Options(), SimpleNamespace(), [], None
    search.settle = lambda plant, x, polished=False: SimpleNamespace(current=last, plant=plant, x=x)
    search._prune = lambda arena: SimpleNamespace(plant="one", x=None) if left else last
    law = SimpleNamespace(effects=[SimpleNamespace(id="a:x")])
    rounds = (Round(["a:x"], 0.5, [{"id": "b:x"}]),)
    begun = search._begin(State(None, None, rounds))  # type: ignore[arg-type]
    assert begun.plant == ("one" if left else None)
    search._exchange(SimpleNamespace(current=SimpleNamespace(plant=law)), list(rounds))
    assert asked == [None if left else {"b:x"}]


def test_a_load_is_asked_in_a_shifts_place_whatever_screening_says() -> None:
    shift, load, other = (FAMILIES[f](("torso",)) for f in ("com_shift", "payload", "drag_linear"))
    found: Any = [SimpleNamespace(effect=other, gain=1.0, columns=np.zeros((4, 0)))]
    lookout: Any = SimpleNamespace(screen=lambda screen, others: found, closer=lambda screen, found: found)
    screen: Any = SimpleNamespace(
        projected=np.zeros(4), try_one=lambda e: SimpleNamespace(effect=e, gain=0.0, columns=np.zeros((4, 0)))
    )
    assert [s.effect.id for s in _picked(lookout, screen, shift, [load, other], True)] == [other.id, load.id]
    assert [s.effect.id for s in _picked(lookout, screen, shift, [load, other], False)] == []


def test_fewer_numbers_are_asked_of_what_is_confirmed_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """And two laws in place of one must outlive half the step as any other."""
    search: Any = object.__new__(Search)
    search.options, search.named, search.say = Options(), [], lambda text: None
    many, plain = (SimpleNamespace(current=n, fitted=SimpleNamespace(plant=n, x=None)) for n in ("many", "plain"))
    found = iter([(SimpleNamespace(id="gain:a+b+c:each"), plain), None])
    monkeypatch.setattr("nfc_gym.measured.search.sparser", lambda *_: next(found))
    search._exchanged = lambda before, after, how: Round([after.plant], 0.0)
    search.settle = lambda plant, x: f"settled {plant}"
    search._confirmed = lambda arena, rounds: f"confirmed {arena}"
    rounds: list[Round] = []
    assert search._plainer(many, rounds) == "confirmed settled plain"
    assert [r.accepted for r in rounds] == [["plain"]]


def test_what_does_as_well_as_a_law_does_as_well_as_the_plain_one_in_its_place() -> None:
    """But for what contains the plain one."""
    search: Any = object.__new__(Search)
    dry, stribeck, viscous = (FAMILIES[f](("knee",)) for f in ("coulomb", "stribeck", "damping_poly"))
    directional = FAMILIES["directional_friction"](("hip", "knee"))
    search.named = [dry, stribeck, viscous, directional]
    before = Round(["coulomb:hip+knee:each"], 0.5, equivalents=[stribeck.id, viscous.id, f"{directional.id}:each"])
    after = Round([dry.id], 0.0)
    search._inherit(after, "coulomb:hip+knee:each", [before])
    assert after.equivalents == [viscous.id]
    search._inherit(two := Round(["a", "b"], 0.0), "coulomb:hip+knee:each", [before])
    assert not two.equivalents


def test_what_the_last_law_met() -> None:
    one, two = Round(["a:x"], 0.5, [{"id": "b:x"}]), Round(["a:x", "b:x"], 0.5, [{"id": "c:x"}])
    none = Round([], 0.0, [{"id": "d:x"}])
    assert _met([two, one, none]) == {"b:x"}
    assert _met([one, two, none]) is None
    assert _met([none]) == set()


@pytest.mark.parametrize(
    ("drop", "ties", "plausible", "listed"),
    [
        (99.0, 0, True, True),
        (99.0, 2, True, True),
        (90.0, 0, True, False),
        (99.0, 9, True, False),
        (99.0, 0, False, False),
    ],
)
def test_a_load_that_does_as_well_in_the_end_is_an_equivalent_of_the_shift(
    drop: float, ties: int, plausible: bool, listed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    shift, load, elsewhere = (
        FAMILIES[f]((b,)) for f, b in (("com_shift", "torso"), ("payload", "torso"), ("payload", "leg"))
    )
    monkeypatch.setattr("nfc_gym.measured.swap.Screen", lambda *_: SimpleNamespace(try_one=lambda e: e))
    asked: list[str] = []
    bare = SimpleNamespace(
        fit_data=SimpleNamespace(problem=None), under=None, current=None,
        judge=lambda fitted: SimpleNamespace(drop=100.0),
        enter=lambda picks: asked.append(picks[0].id) or SimpleNamespace(drop=drop, fits=0),
        ties=lambda best, other, *, priced: other.fits >= ties and not priced,
        enter_again=lambda rival: SimpleNamespace(drop=drop, fits=rival.fits + 1),
        plausible=lambda rival: plausible,
    )  # fmt: skip
    current = SimpleNamespace(plant=SimpleNamespace(effects=[shift]))
    last: Any = SimpleNamespace(current=current, without=lambda effect: bare)
    rounds = [Round([shift.id], 0.5), Round([], 0.0)]
    join_kin(last, rounds, [shift, load, elsewhere])
    assert asked == [load.id]
    assert rounds[0].equivalents == [load.id] * listed
    if listed:
        join_kin(last, rounds, [shift, load, elsewhere])
        assert asked == [load.id], "one that is known is not asked again"
