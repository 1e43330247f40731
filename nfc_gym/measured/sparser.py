"""A law with values of its own at each place, said in plain laws with fewer numbers.

Values of their own suit whatever differs by place: one rotor that is worn on a drone whose rotors all push a little
more, where one number for all and another for that one would do; or knees that all push more than they are told, where
one number for the knees would do and every other joint has none; or one joint that rubs, beside a like one that does
not. Whether these do is asked in the same contest, in which each number has its price.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.arena import Arena
from nfc_gym.measured.contest import Judged
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.each import Each

Array = NDArray[np.float64]
_PLACES = 3  # of fewer, two plain laws are no fewer numbers
_NOTHING = 0.1  # of the squared size at one place, up to which all others together may be nothing


def sparser(arena: Arena, pool: Sequence[Effect], worth: float) -> tuple[Each, Judged] | None:
    """A model in which plain laws do as well as one with values of its own, with fewer numbers; and that one.

    Args:
      arena: whose model to beat has the laws.
      pool: what may be named.
      worth: share of the misfit that laws must explain to be named.
    """
    known = {e.id: e for e in pool}
    plant = arena.current.plant
    for effect, theta in zip(plant.effects, plant.split(arena.current.x)[1], strict=True):
        if not isinstance(effect, Each):
            continue
        without = arena.without(effect)
        own: float | None = None  # what the law itself is worth, judged once a plainer one is believed
        for laws, start in _plainer(effect, theta.reshape(len(effect.members), -1), known):
            rival = without.enter_at(laws, start)
            if not without.believed(rival, worth):
                continue
            own = without.judge(arena.current).total if own is None else own
            if rival.total > own:
                return effect, rival
    return None


def _plainer(effect: Each, values: Array, known: Mapping[str, Effect]) -> Iterator[tuple[list[Effect], list[Array]]]:
    """Laws in place of one, with values to fit them from: the fewest numbers first."""
    if (part := like_part(effect, values, known)) is not None:
        inside = _inside(effect, part)
        yield [part], [np.clip(np.median(values[inside], axis=0), part.low, part.high)]
    if len(values) < _PLACES:
        return
    odd = odd_one_out(values)
    shared, single = (known.get(i) for i in (effect.id.removesuffix(":each"), effect.members[odd].id))
    if shared is not None and single is not None:
        common = np.median(np.delete(values, odd, 0), axis=0)
        yield [shared, single], [common, np.clip(single.null + values[odd] - common, single.low, single.high)]


def like_part(effect: Each, values: Array, known: Mapping[str, Effect]) -> Effect | None:
    """The law at some of the places that comes nearest to values (places, k): alike there, and nothing elsewhere.

    At one place alone only where next to nothing is elsewhere: any values at all are alike there.
    """
    spread = values.std(0)
    unit = np.where(spread > 0, spread, 1.0)
    nothing = np.square((values - effect.members[0].null) / unit).sum(1)
    best, least = None, np.inf
    for law in known.values():
        inside = _inside(effect, law)
        covered = sum(len(m.where) for m, yes in zip(effect.members, inside, strict=True) if yes)
        plain = law.family == effect.family and not isinstance(law, Each) and covered == len(law.where)
        lone = inside.sum() == 1 and nothing[~inside].sum() <= _NOTHING * nothing[inside].sum()
        if plain and (lone or 1 < inside.sum() < len(inside)):
            alike = values[inside] / unit
            apart = np.square(alike - alike.mean(0)).sum() + nothing[~inside].sum()
            best, least = (law, apart) if apart < least else (best, least)
    return best


def _inside(effect: Each, law: Effect) -> NDArray[np.bool_]:
    """(places,) which of them a law acts at."""
    return np.array([set(m.where) <= set(law.where) for m in effect.members])


def odd_one_out(values: Array) -> int:
    """Which row of (places, k) values to leave out for the others to be most alike, each number by its own spread."""
    spread = values.std(0)
    unit = values / np.where(spread > 0, spread, 1.0)
    return int(np.argmin([np.delete(unit, i, 0).var(0).sum() for i in range(len(unit))]))
