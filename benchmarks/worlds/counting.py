"""Does a world count? It does where the nominal policy loses at least 30 % of what it earns beyond a random one."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from .figures import Interval, bootstrap
from .judge import Episodes
from .players import play, player
from .world import World

DROP = 0.30


@dataclass(frozen=True)
class Drop:
    """What a policy loses in a world.

    Attributes:
      world: where; its truth is for the reader of the table.
      nominal, there, random: returns of the policy at home and there, and of a random policy there.
      drop: share of the return beyond the random policy's that is lost.
      episodes: of the policy in the world.
    """

    world: World
    nominal: Interval
    there: Interval
    random: Interval
    drop: float
    episodes: Episodes

    @property
    def counts(self) -> bool:
        """Whether adapting to it shows anything."""
        return self.drop >= DROP


def home(world: World) -> World:
    """The same robot and kind of ground with nothing hidden and no noise: where the policy comes from."""
    return World(world.place, "nominal", world.seed, noisy=False, engine=world.engine)


def mean(returns: list[float], seed: int) -> Interval:
    """Over episodes."""
    return bootstrap([np.array(returns)], np.random.default_rng(seed))


def measure(name: str, world: World, episodes: int, seed: int, before: Episodes | None = None, **settings: Any) -> Drop:
    """How much a policy loses in a world.

    Args:
      name: of the policy, see `players`.
      world: where.
      episodes: in each place.
      seed: of the episodes.
      before: its episodes at home, where they are known.
      settings: of the environment, such as `task`.
    """
    before = before or play(player(name, world, seed), home(world), episodes, seed, **settings)
    there = play(player(name, world, seed), world, episodes, seed, **settings)
    random = play(player("random", world, seed), world, episodes, seed, **settings)
    at_home, here, floor = (mean(e.returns, seed) for e in (before, there, random))
    drop = (at_home.value - here.value) / (at_home.value - floor.value)
    return Drop(world, at_home, here, floor, drop, there)
