"""The same machine at another physics step, and what its roll-outs show between two steps."""

import copy
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.buffers import require_room
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]


def interpolate(grid: Array, step: Array, quaternion: bool) -> Array:
    """Values (P, S, K + 1, dim) on the physics grid at steps (S, h), linearly: (P, S, h, dim)."""
    low = np.clip(np.floor(step + 1e-9).astype(int), 0, grid.shape[2] - 2)
    part = np.clip(step - low, 0, 1)[None, :, :, None]
    block = np.arange(grid.shape[1])[:, None]
    out = grid[:, block, low] * (1 - part) + grid[:, block, low + 1] * part
    return out / np.linalg.norm(out, axis=-1, keepdims=True) if quaternion else out


def finer(plant: Plant) -> Plant:
    """The same plant with half the physics step.

    Raises:
      InputError: a native delay of the model would be shorter (see `buffers`).
    """
    return Plant(_stepped(plant.model, 0.5), plant.space, plant.effects, plant.nthread)


def coarser(plant: Plant) -> Plant:
    """The same plant with twice the physics step."""
    return Plant(_stepped(plant.model, 2.0), plant.space, plant.effects, plant.nthread)


@lru_cache(maxsize=8)
def _stepped(model: mujoco.MjModel, times: float) -> mujoco.MjModel:
    """The model at so many times its step; one and the same for who asks again, so that a residual is known again."""
    model = copy.copy(model)
    model.opt.timestep *= times
    require_room(model, model.opt.timestep)
    return model
