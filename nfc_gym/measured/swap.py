"""Another law in place of one that a greedy search accepted too early.

A greedy search takes what gains most by itself, and the next law mends what the first left; the two right ones together
may do better than both. When nothing more is accepted, each earlier law is therefore taken out in turn, and what would
then be accepted in its place must not be clearly better. What does as well there is an equivalent of the law, though
it may have done worse while what came later was missing. The law accepted last met its rivals beside all the others;
only its own family's other places, of which a round's shortlist has few, are asked again, unless it stands alone. Of
two laws that were accepted at once neither has met any, and what one met beside laws that have left since says nothing.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field

from nfc_gym.measured.arena import Arena, contains
from nfc_gym.measured.choice import NEARLY
from nfc_gym.measured.contest import shortlist
from nfc_gym.measured.fit import Fit
from nfc_gym.measured.lookout import Lookout
from nfc_gym.measured.ranking import Round
from nfc_gym.measured.screen import Screen, Screened, mimics
from nfc_gym.physics.effects.base import Effect

_RIVALS = 3  # refitted in place of each law
_AGAIN = 3  # times that the fit of kin goes on while it comes near the law and does not do as well


@dataclass(frozen=True)
class Swap:
    """What could stand in the places of a model's earlier laws.

    Attributes:
      better: the model with one of them exchanged for a clearly better one, or None.
      alike: ids of what does as well in the place of each, by its own id; all of them if none was exchanged.
    """

    better: Fit | None = None
    alike: dict[str, list[str]] = field(default_factory=dict)


def swapped(
    arena: Arena,
    lookout: Lookout,
    pool: Sequence[Effect],
    worth: float,
    say: Callable[[str], None],
    met: Collection[str] | None = (),
) -> Swap:
    """Look for other laws in the place of each that the model to beat has.

    Args:
      arena: whose model to beat has the laws.
      lookout: which screens.
      pool: candidates.
      worth: share of the misfit that a law must explain to be named.
      met: ids of what the law accepted last was compared with in its round; None where it was accepted with another, or
        where laws that were there then have left.
    """
    alike: dict[str, list[str]] = {}
    effects = arena.current.plant.effects
    for effect in effects:
        others = [e for e in pool if e.id != effect.id]
        asked = met if effect is effects[-1] else None
        if asked is not None:
            others = [e for e in others if e.family == effect.family and e.id not in asked]
        if not others or (asked is not None and len(effects) == 1):
            # A law that stands alone met what does nearly the same in its round, and nothing has joined it since.
            continue
        without = arena.without(effect)
        kept = without.judge(arena.current)
        screen = Screen(without.fit_data.problem, without.under, without.current)
        for pick in _picked(lookout, screen, effect, others, asked is None):
            rival = without.enter([pick])
            if not without.believed(rival, worth):
                continue
            if rival.total > kept.total and not without.ties(rival, kept):
                say(f"{pick.effect.id} in place of {effect.id}: together they explain more")
                return Swap(rival.fitted, alike)
            # What has the law as its special case is no alternative to it.
            if rival.drop <= NEARLY * kept.drop or contains(pick.effect, effect):
                continue
            # The law itself was fitted more than once.
            if without.ties(kept, rival, priced=False) or without.ties(kept, without.enter_again(rival), priced=False):
                alike.setdefault(effect.id, []).append(pick.effect.id)
    return Swap(alike=alike)


def join_kin(arena: Arena, rounds: Sequence[Round], pool: Sequence[Effect]) -> None:
    """Kin of the laws that stand in the end, fitted in their place, join their equivalents where they do as well.

    A load that was fitted while wrong laws stood beside the shift of a centre of mass may have ended in a hollow, and
    these laws have been dropped since.

    Args:
      arena: whose model to beat has the laws.
      rounds: of the search; those that accepted the laws are added to.
      pool: candidates.
    """
    known = {e.id: e for e in pool}
    for effect in arena.current.plant.effects:
        told = next((r for r in reversed(rounds) if effect.id in r.accepted), None)
        kin = [known[i] for family in effect.kin if (i := f"{family}:{effect.place}") in known]
        rivals = [] if told is None else told.rivals(effect.id)
        kin = [e for e in kin if e.id not in rivals and e not in arena.current.plant.effects]
        if told is None or not kin:
            continue
        without = arena.without(effect)
        kept = without.judge(arena.current)
        screen = Screen(without.fit_data.problem, without.under, without.current)
        for law in kin:
            rival = without.enter([screen.try_one(law)])
            for _ in range(_AGAIN):  # beside a large misfit one fit ends on the way along a narrow valley
                if rival.drop <= NEARLY * kept.drop or without.ties(kept, rival, priced=False):
                    break
                rival = without.enter_again(rival)
            as_well = rival.drop > NEARLY * kept.drop and without.ties(kept, rival, priced=False)
            if as_well and without.plausible(rival):
                rivals.append(law.id)


def _picked(
    lookout: Lookout, screen: Screen, effect: Effect, others: Sequence[Effect], leading: bool
) -> list[Screened]:
    """What is refitted in a law's place: what screening cannot tell from it, and before these what leads there."""
    found = lookout.screen(screen, others)
    found = lookout.closer(screen, found) if leading else found
    picks = shortlist(found, _RIVALS) if leading else []
    if leading:  # straight lines may not show the likeness of laws that are kin
        known, kin = {s.effect.id: s for s in found}, {f"{family}:{effect.place}" for family in effect.kin}
        kin -= {s.effect.id for s in picks}
        picks += [known.get(e.id) or screen.try_one(e) for e in others if e.id in kin]
    # Many places of one family may look better than the one where it does what the law does.
    rest = [s for s in found if not any(s.effect is p.effect for p in picks)]
    return [*picks, *mimics(screen.try_one(effect), rest, screen.projected)]
