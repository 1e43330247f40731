"""The box that a fit searches: bounds, typical sizes and free entries of psi and effects' parameters, in coordinates
in which the motion depends on them as nearly linearly as their effects can say (`Effect.chart`).
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from nfc_gym.physics.effects.base import Effect, overrides
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
_PRIOR = 0.5  # of the prior's range: standard deviation of the weak pull towards nominal psi


@dataclass(frozen=True)
class Box:
    """Bounds and scales of a plant's full parameter vector (n,).

    Attributes:
      low, high: (n,) bounds of the parameters themselves.
      free: (n,) False where anchored.
      scale: (f,) typical size of each free coordinate; scaled coordinates z are coordinates over it.
      floor, roof: (f,) bounds of z.
      centre: (f,) z of nominal psi and of effects at null.
      pull: (f,) scaled coordinates over their prior's standard deviation: the weak prior's weights.
    """

    plant: Plant
    low: Array
    high: Array
    free: NDArray[np.bool_]
    scale: Array
    floor: Array
    roof: Array
    centre: Array
    pull: Array

    def at(self, x: Array) -> Array:
        """Scaled free coordinates (..., f) of parameter vectors (..., n)."""
        return self.plant.chart(x)[..., self.free] / self.scale

    def x(self, z: Array, around: Array) -> Array:
        """Parameter vectors (..., n) within their bounds at z (..., f); anchored entries are those of `around` (n,)."""
        coordinates = np.broadcast_to(self.plant.chart(around), (*z.shape[:-1], len(self.free))).copy()
        coordinates[..., self.free] = z * self.scale
        return np.clip(self.plant.unchart(coordinates), self.low, self.high)

    def pulled(self, z: Array) -> Array:
        """(...) what the weak priors take of scaled coordinates (..., f): the squares of how far they are pulled."""
        return np.square((z - self.centre) * self.pull).sum(-1)

    def slopes(self, x: Array) -> Array:
        """(n, f) change of the parameters for each scaled free coordinate, at x (n,)."""
        z = self.at(x)
        step = 1e-6 * np.eye(len(z))
        coordinates = np.repeat(self.plant.chart(x)[None], 2 * len(z), 0)
        coordinates[:, self.free] = np.concatenate([z + step, z - step]) * self.scale
        up, down = np.split(self.plant.unchart(coordinates), 2)
        return (up - down).T / 2e-6


def box(plant: Plant) -> Box:
    """Bounds and scales of psi followed by every effect's parameters."""
    space = plant.space
    low, high = [space.low], [space.high]
    floor, roof, scale = [space.low], [space.high], [(space.high - space.low) / 4]
    free, spread = [space.free], [_PRIOR * (space.high - space.low)]
    for effect in plant.effects:
        count = len(effect.params)
        low.append(effect.low)
        high.append(effect.high)
        corners = effect.chart(_corners(effect)) if overrides(effect, "chart") else np.stack([effect.low, effect.high])
        floor.append(corners.min(0))
        roof.append(corners.max(0))
        scale.append(np.abs(effect.chart(_typical(effect)) - effect.chart(effect.null)).max(0))
        free.append(np.ones(count, bool))
        spread.append(np.full(count, np.inf))
    join = np.concatenate
    of, size = join(free), join(scale)
    z = lambda rows: join(rows)[of] / size[of]  # noqa: E731
    return Box(
        plant, join(low), join(high), of, size[of], z(floor), z(roof),
        plant.chart(plant.null)[of] / size[of], size[of] / join(spread)[of],
    )  # fmt: skip


def _corners(effect: Effect) -> Array:
    return np.array(list(product(*zip(effect.low, effect.high, strict=True))))


def _typical(effect: Effect) -> Array:
    """(2, k) parameters a typical size away from null, to both sides."""
    sizes = []
    for p, null in zip(effect.params, effect.null, strict=True):
        away = max((abs(probe - null) for probe in p.probes), default=0.0)
        sizes.append(away or p.high - p.low)
    return effect.null + np.outer([1.0, -1.0], sizes)
