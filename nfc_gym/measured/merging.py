"""One cause in place of two that were accepted one after the other.

A load is a shifted centre of mass and a mass: where psi has taken up some of the mass, the shift alone is believed
first, and what is left of the mass comes as something else, drives that all push less, say. Beside the shift the load
then gains no more than that does; only in place of both does it show.
"""

from collections.abc import Sequence
from itertools import combinations

from nfc_gym.measured.arena import Arena
from nfc_gym.measured.contest import Judged
from nfc_gym.measured.screen import Screen
from nfc_gym.physics.effects.base import Effect


def merged(arena: Arena, pool: Sequence[Effect], worth: float) -> tuple[tuple[Effect, Effect], Judged] | None:
    """A model in which one law does better than two of its laws, with no more numbers; and those two.

    It is asked of the law at the place of one of them that promises most in place of both.

    Args:
      arena: whose model to beat has the laws.
      pool: what may be named.
      worth: share of the misfit that a law must explain to be named.
    """
    effects = arena.current.plant.effects
    for two in combinations([e for e in effects if not e.generic], 2):
        rivals = [e for e in pool if _may_replace(e, two) and e not in effects]
        if not rivals:
            continue
        without = arena
        for effect in two:
            without = without.without(effect)
        screen = Screen(arena.fit_data.problem, without.under, without.current)
        best = max((screen.try_one(e) for e in rivals), key=lambda s: s.gain)
        rival = without.enter([best])
        if without.believed(rival, worth) and rival.total > without.judge(arena.current).total:
            return two, rival
    return None


def _may_replace(law: Effect, two: Sequence[Effect]) -> bool:
    """Whether a law acts where one of two does, and has no more numbers than both together.

    Nor fewer than each: a plainer law than one of them was beaten by it already. It may be of the other one's kind: a
    load on an arm mends the shift that is believed of the base, and the load is the base's.
    """
    sizes = [len(e.params) for e in two]
    there = any(set(law.where) == set(e.where) and law.family != e.family for e in two)
    return there and max(sizes) <= len(law.params) <= sum(sizes)
