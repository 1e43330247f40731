"""Whether a claim leads what else might be at work by more than it leaves over.

Where something remains, the model still lacks a law, and what that law does might do for a rival what it cannot do for
the claim. A claim that leads several rivals by less than it leaves is one guess among these, however many standard
deviations lie between them: those know of the noise alone. What is left where neither the claim nor the rival changes
anything is another law's, and tells nothing between the two.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.arena import Arena, contains
from nfc_gym.measured.contest import mechanism
from nfc_gym.measured.fit import Fit
from nfc_gym.measured.metric import taken
from nfc_gym.measured.ranking import Round
from nfc_gym.measured.screen import Screen
from nfc_gym.measured.settle import slack
from nfc_gym.physics.effects.base import Effect

Array = NDArray[np.float64]
_ASKED = 4  # rivals of each claim, one a family
_ALIKE = 2  # of these that do nearly as well: three families in all, of which none is shown to be the cause
_CHANGED = 0.05  # of a column's variance beyond the noise, from which on a law changes something there


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
        noise = _noise(bare)
        before, own = (_errors(bare, fitted) for fitted in (bare.current, arena.current))
        arena.say(f"asking what would do as well as {effect.id}")
        screen = Screen(bare.fit_data.problem, bare.under, bare.current)
        others = [_errors(bare, bare.enter([screen.try_one(r)]).fitted) for r in rivals]
        alike = [r.id for r, other in zip(rivals, others, strict=True) if _nearly(before, own, other, noise)]
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


def _nearly(before: Array, own: Array, other: Array, noise: Array) -> bool:
    """Whether a rival takes away as much as the claim but for less than the claim leaves, where either does anything.

    Args:
      before, own, other: (m,) mean squared errors of the columns without either, under the claim, under the rival.
      noise: (m,) what the noise makes of them.
    """
    least = _CHANGED * (before - noise)
    changed = (np.abs(before - own) > least) | (np.abs(before - other) > least)
    share, rival = (taken(before[changed], after[changed], noise[changed]) for after in (own, other))
    return rival >= share - (1 - share)


def _noise(bare: Arena) -> Array:
    """(m,) mean variance of the noise that is expected in each column."""
    data = bare.fit_data
    return np.einsum("sii->i", data.sigma) / max(len(data.problem), 1)


def _errors(bare: Arena, fitted: Fit) -> Array:
    """(m,) mean squared error of each column under a model, never less than the noise."""
    data = bare.fit_data
    return slack(data.problem, data.sigma, fitted.plant, fitted.x) + _noise(bare)
