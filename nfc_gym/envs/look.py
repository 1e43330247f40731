"""Elevation maps around robots, as both engines look them up and hold them between two refreshes."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nfc_gym.envs.rotations import yaw
from nfc_gym.terrain import Heightfield, elevation
from nfc_gym.terrain.egocentric import SIZE

Maps = NDArray[np.float32]


def look(qpos: NDArray, perceived: Heightfield | Sequence[Heightfield] | None) -> Maps:
    """Fresh maps (..., SIZE, SIZE) around robots with positions (..., nq).

    Args:
      qpos: base position and quaternion first.
      perceived: a map, or one for each robot; None is flat ground.
    """
    if perceived is not None:
        return elevation(perceived, qpos[..., :3], yaw(qpos[..., 3:7]))
    out = np.empty((*qpos.shape[:-1], SIZE, SIZE), np.float32)
    out[...] = -qpos[..., 2, None, None].astype(np.float32)
    return out


class HeldMaps:
    """The last maps of n robots, each renewed every so many control steps of its own episode.

    Args:
      n: robots.
      period: control steps between two refreshes.
    """

    def __init__(self, n: int, period: int) -> None:
        self._period = period
        self._held = np.empty((n, SIZE, SIZE), np.float32) if period > 1 else None

    def around(
        self,
        qpos: NDArray,
        perceived: Sequence[Heightfield] | None,
        which: NDArray[np.intp],
        steps: NDArray[np.integer],
        rows: NDArray[np.bool_] | None,
    ) -> Maps:
        """Fresh arrays (k, SIZE, SIZE), of which those that are not due are copies of the last ones.

        Args:
          qpos: (n, nq).
          perceived: maps to choose from; None is flat ground.
          which: (n,) map of each robot.
          steps: (n,) control steps since the reset.
          rows: (n,) whose maps are wanted, k of them; None is all.
        """
        due = np.ones(len(qpos), bool) if self._held is None else steps % self._period == 0
        ids = np.flatnonzero(due if rows is None else due & rows)
        if self._held is None:
            return self._look(qpos, perceived, which, ids)
        if len(ids):
            self._held[ids] = self._look(qpos, perceived, which, ids)
        return self._held.copy() if rows is None else self._held[rows]

    @staticmethod
    def _look(qpos: NDArray, perceived: Sequence[Heightfield] | None, which: NDArray, ids: NDArray) -> Maps:
        return look(qpos[ids], None if perceived is None else [perceived[k] for k in which[ids]])
