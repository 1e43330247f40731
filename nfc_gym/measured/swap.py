"""Another law in place of one that a greedy search accepted too early.

A greedy search takes what gains most by itself, and the next law mends what the first left; the two right ones together
may do better than both. When nothing more is accepted, each earlier law is therefore taken out in turn, and what would
then be accepted in its place must not be clearly better. What does as well there is an equivalent of the law, though
it may have done worse while what came later was missing.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from nfc_gym.measured.arena import Arena, contains
from nfc_gym.measured.contest import shortlist
from nfc_gym.measured.fit import Fit
from nfc_gym.measured.lookout import Lookout
from nfc_gym.measured.rounds import NEARLY
from nfc_gym.measured.screen import Screen, mimics
from nfc_gym.physics.effects.base import Effect

_RIVALS = 3  # refitted in place of each law


@dataclass(frozen=True)
class Swap:
    """What could stand in the places of a model's earlier laws.

    Attributes:
      better: the model with one of them exchanged for a clearly better one, or None.
      alike: ids of what does as well in the place of each, by its own id; all of them if none was exchanged.
    """

    better: Fit | None = None
    alike: dict[str, list[str]] = field(default_factory=dict)


def swapped(arena: Arena, lookout: Lookout, pool: Sequence[Effect], worth: float, say: Callable[[str], None]) -> Swap:
    """Look for other laws in the place of each that the model to beat has, but the last.

    Args:
      arena: whose model to beat has the laws.
      lookout: which screens.
      pool: candidates.
      worth: share of the misfit that a law must explain to be named.
    """
    alike: dict[str, list[str]] = {}
    # The last law accepted was the best of all beside the others.
    for effect in arena.current.plant.effects[:-1]:
        without = arena.without(effect)
        kept = without.judge(arena.current)
        screen = Screen(without.fit_data.problem, without.under, without.current)
        others = [e for e in pool if e.id != effect.id]
        found = lookout.closer(screen, lookout.screen(screen, others))
        picks = shortlist(found, _RIVALS)
        # Many places of one family may look better than the one where it does what the law does.
        picks += mimics(screen.try_one(effect), [s for s in found if not any(s is p for p in picks)], screen.projected)
        for pick in picks:
            rival = without.enter([pick])
            if not (without.worth(rival, worth) and without.plausible(rival) and without.told_apart(rival)):
                continue
            if rival.total > kept.total and not without.ties(rival, kept):
                say(f"{pick.effect.id} in place of {effect.id}: together they explain more")
                return Swap(rival.fitted, alike)
            # What has the law as its special case is no alternative to it.
            if rival.total <= NEARLY * kept.total or contains(pick.effect, effect):
                continue
            # The law itself was fitted more than once.
            if without.ties(kept, rival) or without.ties(kept, without.enter_again(rival)):
                alike.setdefault(effect.id, []).append(pick.effect.id)
    return Swap(alike=alike)
