"""How fast a robot may have been moving when a window began: what its first, noisy observation leaves open.

Velocities are in the robot's own frame, where wheels and ground, or legs and joints, make them belong together: their
covariance S over windows is what is known before. The first observation h(velocities) + noise, of which h's slope H is
taken by differences, leaves (S^-1 + H' R^-1 H)^-1. Positions are taken as known: how deep a foot stands in the ground
decides the next impact, and no covariance says that.
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.inference.windows import Batch
from nfc_gym.physics.state import rotate, rotate_back
from nfc_gym.simulate.machine import Machine

Array = NDArray[np.float64]
STEP = 1e-3  # m/s and rad/s, of the differences
_LEAST = 1e-6  # of a velocity's variance: keeps its covariance invertible where one follows from the others


def speeds(machine: Machine, start: Array) -> Array:
    """(n, nv) velocities in the own frame, of the simulator's states (n, m) that windows keep as `start`."""
    model = machine.model
    data, kind = mujoco.MjData(model), mujoco.mjtState.mjSTATE_INTEGRATION
    out = np.empty((len(start), model.nv))
    for i, state in enumerate(np.ascontiguousarray(start, dtype=np.float64)):
        mujoco.mj_setState(model, data, state, kind)
        out[i] = data.qvel
        out[i, :3] = rotate_back(data.qpos[3:7], data.qvel[:3])
    return out


def spread(machine: Machine, windows: Batch) -> Array:
    """S (nv, nv) over windows, as `Windows` gives them: `start` is read."""
    found = speeds(machine, windows["start"])
    covariance = np.cov(found.T)
    return covariance + _LEAST * np.diag(np.maximum(np.diag(covariance), _LEAST))


def world(own: Array, quat: Array) -> Array:
    """Changes of velocity (m, nv) in the own frame, as MuJoCo has them: those of a free body's place in the world's."""
    out = own.copy()
    out[:, :3] = rotate(quat, own[:, :3])
    return out


def left_open(seen: Array, noise: Array, before: Array) -> Array:
    """(nv, nv) factor L: velocities off by L c, c ~ N(0, I), are what the first observation leaves open.

    Args:
      seen: (1 + nv, s) observed at the start, and with each velocity raised by `STEP`.
      noise: (s,) standard deviation of each entry; those without noise are the task's and tell nothing here.
      before: S.
    """
    told = noise > 0
    slope = (seen[1:, told] - seen[0, told]) / STEP / noise[told]
    after = np.linalg.inv(np.linalg.inv(before) + slope @ slope.T)
    return np.asarray(np.linalg.cholesky((after + after.T) / 2), float)
