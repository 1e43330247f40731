"""Another law in place of one that a greedy search accepted too early.

A greedy search takes what gains most by itself, and the next law mends what the first left; the two right ones together
may do better than both. When nothing more is accepted, each earlier law is therefore taken out in turn, and what would
then be accepted in its place must not be clearly better.
"""

from collections.abc import Callable, Sequence

from nfc_gym.measured.arena import Arena
from nfc_gym.measured.contest import shortlist
from nfc_gym.measured.fit import Fit
from nfc_gym.measured.lookout import Lookout
from nfc_gym.measured.screen import Screen
from nfc_gym.physics.effects.base import Effect

_RIVALS = 3  # refitted in place of each law


def swapped(
    arena: Arena, lookout: Lookout, pool: Sequence[Effect], worth: float, say: Callable[[str], None]
) -> Fit | None:
    """The model to beat with one of its laws exchanged for a clearly better one, or None.

    Args:
      arena: whose model to beat has the laws.
      lookout: which screens.
      pool: candidates.
      worth: share of the misfit that a law must explain to be named.
    """
    # The last law accepted was the best of all beside the others.
    for effect in arena.current.plant.effects[:-1]:
        without = arena.without(effect)
        kept = without.judge(arena.current)
        screen = Screen(without.fit_data.problem, without.under, without.current)
        others = [e for e in pool if e.id != effect.id]
        for pick in shortlist(lookout.closer(screen, lookout.screen(screen, others)), _RIVALS):
            rival = without.enter([pick])
            better = rival.total > kept.total and not without.ties(rival, kept)
            if better and without.worth(rival, worth) and without.plausible(rival) and without.told_apart(rival):
                say(f"{pick.effect.id} in place of {effect.id}: together they explain more")
                return rival.fitted
    return None
