"""Whether a claim leads what else might be at work by more than it leaves over.

Where something remains, the model still lacks a law, and what that law does might do for a rival what it cannot do for
the claim. A claim that leads several rivals by less than it leaves is one guess among these, however many standard
deviations lie between them: those know of the noise alone.
"""

from collections.abc import Sequence

import numpy as np

from nfc_gym.measured.arena import Arena, contains
from nfc_gym.measured.contest import mechanism
from nfc_gym.measured.fit import Fit
from nfc_gym.measured.metric import taken
from nfc_gym.measured.ranking import Round
from nfc_gym.measured.screen import Screen
from nfc_gym.measured.settle import slack
from nfc_gym.physics.effects.base import Effect

_ASKED = 4  # rivals of each claim, one a family
_ALIKE = 2  # of these that do nearly as well: three families in all, of which none is shown to be the cause


def doubted(arena: Arena, rounds: Sequence[Round], pool: Sequence[Effect]) -> dict[str, list[str]]:
    """Accepted effects that lead several rivals by less than they leave over; with these rivals.

    Args:
      arena: whose model to beat has the effects.
      rounds: of the search, which say who came near.
      pool: what may be named.

    Returns:
      Ids of the doubted effects, each with the ids of what would take away nearly as much in its place.
    """
    out = {}
    for effect in arena.current.plant.effects:
        rivals = _rivals(effect, arena.current.plant.effects, rounds, pool)
        if len(rivals) < _ALIKE:
            continue
        bare = arena.without(effect)
        own = _share(bare, arena.current)
        arena.say(f"asking what would do as well as {effect.id}")
        screen = Screen(bare.fit_data.problem, bare.under, bare.current)
        alike = [r.id for r in rivals if _share(bare, bare.enter([screen.try_one(r)]).fitted) >= own - (1 - own)]
        if len(alike) >= _ALIKE:
            out[effect.id] = alike
    return out


def _rivals(effect: Effect, taking: Sequence[Effect], rounds: Sequence[Round], pool: Sequence[Effect]) -> list[Effect]:
    """The leading candidates of other mechanisms in the round that accepted an effect, one a family."""
    known, present = {e.id: e for e in pool}, {e.id for e in taking}
    label = effect.id.removesuffix(":each")
    for r in rounds:
        if not any(i.removesuffix(":each") == label for i in r.accepted):
            continue
        best: dict[str, Effect] = {}
        for row in r.ranking:
            rival = known.get(row["id"].removesuffix(":each"))
            if rival is None or rival.id in present or mechanism(rival) == mechanism(effect):
                continue
            if rival.family != effect.family and not contains(rival, effect) and not contains(effect, rival):
                best.setdefault(rival.family, rival)
        return list(best.values())[:_ASKED]
    return []


def _share(bare: Arena, fitted: Fit) -> float:
    """Share of the variance beyond the noise that a model takes away of what the arena's model to beat leaves."""
    data = bare.fit_data
    noise = np.einsum("sii->i", data.sigma) / max(len(data.problem), 1)
    before, after = (slack(data.problem, data.sigma, f.plant, f.x) + noise for f in (bare.current, fitted))
    return taken(before, after, noise)
