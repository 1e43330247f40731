"""Ground of a shard: a pool of seeded maps, and where on them the motion begins."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nfc_gym import terrain
from nfc_gym.envs.simulations import Simulations
from nfc_gym.simulate.draws import GROUND, Array, between, generator
from nfc_gym.simulate.machine import Machine

MAPS = 24  # a shard
DIFFICULTY = (0.05, 0.6)  # of `terrain.make`; environments have 0.5 by default
_TRIES = 6  # spots of which the first clear one is taken
_CLEAR = 0.9  # m around a spot of the air that must be free: a quadcopter's reach and its way of 0.4 s
_AROUND = np.stack(np.meshgrid(*(2 * [np.linspace(-_CLEAR, _CLEAR, 7)])), -1).reshape(-1, 2)


@dataclass(frozen=True)
class Ground:
    """Maps of a shard; `kind` indexes `Machine.terrain_kinds`. Difficulties are float32, as windows keep them."""

    kind: NDArray[np.int16]
    seed: NDArray[np.int64]
    difficulty: NDArray[np.float32]
    maps: list[terrain.Heightfield]

    @classmethod
    def of(cls, machine: Machine, seed: int, shard: int) -> "Ground":
        """The maps of a shard; none on a plane."""
        if not machine.rough:
            return cls(np.zeros(0, np.int16), np.zeros(0, np.int64), np.zeros(0, np.float32), [])
        rng = generator(seed, shard, GROUND)
        names = rng.choice(machine.kinds_of_ground(), MAPS)
        kind = np.array([machine.terrain_kinds.index(n) for n in names], np.int16)
        seeds = rng.integers(2**31, size=MAPS)
        difficulty = rng.uniform(*DIFFICULTY, MAPS).astype(np.float32)
        scale = machine.kind.terrain_scale
        each = zip(names, seeds, difficulty, strict=True)
        return cls(kind, seeds, difficulty, [made(str(k), int(s), float(d), scale) for k, s, d in each])

    @classmethod
    def given(cls, maps: Sequence[terrain.Heightfield]) -> "Ground":
        """Maps that were not made from seeds: their kind is -1."""
        n = len(maps)
        return cls(np.full(n, -1, np.int16), np.zeros(n, np.int64), np.zeros(n, np.float32), list(maps))


@lru_cache(maxsize=128)
def made(kind: str, seed: int, difficulty: float, scale: float) -> terrain.Heightfield:
    """One map, kept for a while."""
    return terrain.make(kind, difficulty, seed, scale=scale)


def begin(machine: Machine, sims: Simulations, psi: Array, which: NDArray[np.intp], u: Array) -> Array:
    """Begin an episode in every simulation, anywhere on its map.

    Args:
      machine, sims: the robot.
      psi: (n, d) in physical units.
      which: (n,) map of each.
      u: (n, 2 `_TRIES` + draws) uniform numbers.

    Returns:
      (n, 2) m, by how much the robot's own start was shifted.
    """
    given = {"psi": psi, "terrain_id": which} if machine.rough else {"psi": psi}
    sims.begin(np.arange(sims.n), given)
    shift = np.zeros((sims.n, 2))
    if machine.rough:
        spots = between(u[:, : 2 * _TRIES], -machine.habit.roam, machine.habit.roam).reshape(-1, _TRIES, 2)
        shift = spots[:, 0]
        if machine.kind.terrain_kind == "obstacles":
            top = sims.ground((spots[:, :, None] + _AROUND).reshape(sims.n, -1, 2), which).reshape(*spots.shape[:2], -1)
            shift = spots[np.arange(sims.n), (top.max(-1) < _CLEAR).argmax(1)]
    start = sims.robot.begin(u[:, 2 * _TRIES :], lambda xy: sims.ground(xy + shift[:, None], which))
    view = sims.view
    view.qpos[...], view.qvel[...] = start.qpos, start.qvel
    view.qpos[:, :2] += shift
    view.task.update(start.task)
    for name in ("goal", "start", "place"):
        if name in start.task and machine.rough:
            place = start.task[name].copy()
            place[:, :2] += shift
            view.task[name] = place
    return shift


def count(machine: Machine) -> int:
    """How many uniform numbers a start is made of."""
    return 2 * _TRIES + machine.kind.draws
