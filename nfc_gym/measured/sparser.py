"""A law with values of its own at each place, said as one that all places share and another at the one that differs.

Values of their own suit whatever differs by place, one rotor that is worn on a drone whose rotors all push a little
more, say: there they are one number a rotor where two would do. Whether these do is asked in the same contest, in
which each number has its price.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.arena import Arena
from nfc_gym.measured.contest import Judged
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.each import Each

Array = NDArray[np.float64]
_PLACES = 3  # of fewer, two laws are no fewer numbers


def sparser(arena: Arena, pool: Sequence[Effect], worth: float) -> tuple[Each, Judged] | None:
    """A model in which two plain laws do as well as one with values of its own, with fewer numbers; and that one.

    Args:
      arena: whose model to beat has the laws.
      pool: what may be named.
      worth: share of the misfit that laws must explain to be named.
    """
    known = {e.id: e for e in pool}
    plant = arena.current.plant
    for effect, theta in zip(plant.effects, plant.split(arena.current.x)[1], strict=True):
        if not isinstance(effect, Each) or len(effect.members) < _PLACES:
            continue
        values = theta.reshape(len(effect.members), -1)
        odd = odd_one_out(values)
        plain = [known.get(i) for i in (effect.id.removesuffix(":each"), effect.members[odd].id)]
        shared, single = plain
        if shared is None or single is None:
            continue
        without = arena.without(effect)
        common = np.median(np.delete(values, odd, 0), axis=0)
        start = [common, np.clip(single.null + values[odd] - common, single.low, single.high)]
        rival = without.enter_at([shared, single], start)
        if without.believed(rival, worth) and rival.total > without.judge(arena.current).total:
            return effect, rival
    return None


def odd_one_out(values: Array) -> int:
    """Which row of (places, k) values to leave out for the others to be most alike, each number by its own spread."""
    spread = values.std(0)
    unit = values / np.where(spread > 0, spread, 1.0)
    return int(np.argmin([np.delete(unit, i, 0).var(0).sum() for i in range(len(unit))]))
