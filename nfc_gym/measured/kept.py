"""A search's state as plain data, from which an interrupted search goes on bit for bit.

Effects are kept by their ids alone and found again among the candidates, which the same logs propose anew: bounds,
probing sizes and the identity by which a search tells its effects apart are then those of a run without interruption.
Numbers are Python floats, whose JSON form reads back exactly.
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from nfc_gym.measured.ranking import Round
from nfc_gym.measured.search import State
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.each import split
from nfc_gym.physics.rollout import Plant

_OWN = ":each"  # the end of the id of a law with values of its own at each place


def pack_state(state: State) -> dict[str, Any]:
    """JSON-able data of a state; `unpack_state` reads it back."""
    return {
        "x": state.x.tolist(),
        "effects": [e.id for e in state.plant.effects],
        "rounds": [asdict(r) for r in state.rounds],
        "hopeless": sorted(state.hopeless),
    }


def unpack_state(data: dict[str, Any], plant: Plant, pool: Sequence[Effect]) -> State | None:
    """The state, its effects taken from a pool of candidates; None where one is not there, and the search starts over.

    Args:
      data: what `pack_state` gave.
      plant: the machine without effects.
      pool: the candidates of the search.
    """
    by_id = {e.id: e for e in pool}
    found = [_find(i, by_id, plant) for i in data["effects"]]
    effects = [e for e in found if e is not None]
    if len(effects) < len(found):
        return None
    rounds = tuple(Round(**r) for r in data["rounds"])
    return State(plant.with_effects(effects), np.array(data["x"], float), rounds, frozenset(data["hopeless"]))


def _find(effect_id: str, by_id: dict[str, Effect], plant: Plant) -> Effect | None:
    tied = by_id.get(effect_id.removesuffix(_OWN))
    if tied is None or not effect_id.endswith(_OWN):
        return tied
    apart = split(tied, plant)
    return None if apart is None else apart[0]
