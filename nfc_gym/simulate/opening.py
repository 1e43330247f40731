"""`Opening`: where a window may have begun, as a normal whose mean goes with psi."""

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from nfc_gym.physics.state import Tangent, move
from nfc_gym.simulate.likely import Likely, lowest, touching

Array = NDArray[np.float64]
_DRAWS = 2000
_HEIGHT = 2  # of a free joint's six
_LEAST = 1e-6  # of the largest eigenvalue of the starts' correlations: what varies less is taken as known


class Opening:
    """Starts x(z, c) = x0 + m + B z + L c, with z of psi (`PriorBox`) and c ~ N(0, I), in the model's tangent space.

    In place of the base's height stands how far its lowest geom is above the plane: whether a foot touches the ground
    decides what it does next, and a height that fits one attitude buries it at the next.

    Args:
      likely: draws starts that the first observation leaves open.
      rng: of the draws that this is a normal through.

    Attributes:
      size: entries of c.
    """

    def __init__(self, likely: Likely, rng: np.random.Generator) -> None:
        self.model = model = likely.machine.model
        self._tangent, self._data, self._touching = Tangent(model), mujoco.MjData(model), touching(model)
        z = rng.standard_normal((_DRAWS, len(likely.machine.space)))
        starts = likely.draw(ndtr(z), rng)
        typical = np.abs(starts - np.median(starts, 0)) / (starts.std(0) + 1e-9)
        self._origin = starts[int(typical.sum(1).argmin())].copy()
        away = self._away(starts)
        self._mean = away.mean(0)
        self._slope = np.linalg.lstsq(z, away - self._mean, rcond=None)[0].T
        covariance = np.cov((away - self._mean - z @ self._slope.T).T)
        scale = np.sqrt(np.diag(covariance)) + 1e-9
        values, vectors = np.linalg.eigh(covariance / scale[:, None] / scale)
        told = values > _LEAST * values.max()
        self._root = scale[:, None] * vectors[:, told] * np.sqrt(values[told])
        self.size = int(told.sum())

    def starts(self, z: Array, c: Array) -> Array:
        """(n, nq + nv + na) of z (n, d) and c (n, `size`)."""
        nq, nv = self.model.nq, self.model.nv
        away = self._mean + z @ self._slope.T + c @ self._root.T
        qpos = np.tile(self._origin[:nq], (len(away), 1))
        move(self.model, qpos, np.ascontiguousarray(away[:, :nv]))
        for row, above in zip(qpos, away[:, _HEIGHT], strict=True):
            row[2] += above - self._above(row)
        return np.concatenate([qpos, self._origin[nq:] + away[:, nv:]], 1)

    def _away(self, starts: Array) -> Array:
        """(n, 2 nv + na) of starts from the origin; of the height it is how far above the plane they are."""
        nq = self.model.nq
        origin = np.tile(self._origin, (len(starts), 1))
        joints = self._tangent.difference(origin[:, :nq], starts[:, :nq])
        joints[:, _HEIGHT] = [self._above(row) for row in starts]
        return np.concatenate([joints, starts[:, nq:] - origin[:, nq:]], 1)

    def _above(self, start: Array) -> float:
        self._data.qpos[:] = start[: self.model.nq]
        return lowest(self.model, self._data, *self._touching)
