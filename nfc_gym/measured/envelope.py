"""How far a proposed motion may go: the model's joint ranges, and what the logs have shown times a margin."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.states import States

Array = NDArray[np.float64]
MARGIN = 1.2  # times what was seen
_LEAST = 0.02  # m, m/s, rad, rad/s: nearer to rest than this everything is allowed
_SLIGHT = np.array([0.02, 0.02, 0.05])  # m, m, rad: the same for a free body's ways and tilt
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)


@dataclass(frozen=True)
class Envelope:
    """Bounds of a motion; positions of free bodies are bounded about where the motion began.

    Attributes:
      scalar: (j,) addresses of bounded joint coordinates; low, high: (j,) their bounds.
      free: addresses (qpos) of free joints; reach: (f, 3) horizontal and vertical way in m, and tilt in rad.
      speed: (nv,) largest speeds; infinite where never measured.
    """

    scalar: NDArray[np.intp]
    low: Array
    high: Array
    free: tuple[int, ...]
    reach: Array
    speed: Array

    def overstep(self, qpos: Array, qvel: Array, moving: bool = True) -> Array:
        """(N,) by how much motions (N, K, nq), (N, K, nv) leave the bounds, as a share of them; 0 inside.

        Args:
          moving: whether the motions begin where the machine does; else ways are not compared.
        """
        q = qpos[:, :, self.scalar]
        width = np.maximum(self.high - self.low, 1e-9)
        parts = [np.maximum(self.low - q, q - self.high) / width, np.abs(qvel) / self.speed - 1]
        for address, reach in zip(self.free, self.reach, strict=True):
            went = travel(qpos[:, :, address : address + 7])
            parts.append((went / reach - 1)[..., (0 if moving else 2) :])
        worst = np.concatenate([p.reshape(len(qpos), -1) for p in parts], 1).max(1, initial=0.0)
        return np.where(np.isfinite(worst), np.maximum(worst, 0.0), 1e3)


def travel(pose: Array) -> Array:
    """(..., K, 3) horizontal way and vertical way from the first of K poses (..., K, 7), and tilt of the body's z."""
    away = pose[..., :3] - pose[..., :1, :3]
    upright = 1 - 2 * (pose[..., 4] ** 2 + pose[..., 5] ** 2)
    tilt = np.arccos(np.clip(upright, -1, 1))
    return np.stack([np.linalg.norm(away[..., :2], axis=-1), np.abs(away[..., 2]), tilt], -1)


def envelope(model: mujoco.MjModel, seen: Sequence[States], margin: float = MARGIN) -> Envelope:
    """Joint ranges of the model; for all else that was measured, what was seen times `margin`.

    A joint without a range that was seen to turn more than once may turn for ever.
    """
    scalar, low, high, free, reach = [], [], [], [], []
    for j in range(model.njnt):
        q, v, kind = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j]), int(model.jnt_type[j])
        if kind == _FREE:
            ways = np.concatenate([travel(s.qpos[:, q : q + 7]) for s in seen]).max(0)
            free.append(q)
            reach.append(np.where(seen[0].observed[[v, v, v + 3]], margin * np.maximum(ways, _SLIGHT), np.inf))
        elif kind >= int(mujoco.mjtJoint.mjJNT_SLIDE):
            values = np.concatenate([s.qpos[:, q] for s in seen])
            bounds = _bounds(model, j, values, margin) if seen[0].observed[v] or model.jnt_limited[j] else None
            if bounds is not None:
                scalar.append(q)
                low.append(bounds[0])
                high.append(bounds[1])
    fastest = np.max([np.abs(s.qvel).max(0) for s in seen], axis=0)
    speed = np.where(seen[0].observed, margin * np.maximum(fastest, _LEAST), np.inf)
    return Envelope(
        np.array(scalar, np.intp), np.array(low), np.array(high), tuple(free), np.array(reach).reshape(-1, 3), speed
    )


def _bounds(model: mujoco.MjModel, joint: int, values: Array, margin: float) -> tuple[float, float] | None:
    if model.jnt_limited[joint]:
        low, high = map(float, model.jnt_range[joint])
        return low, high
    hinge = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_HINGE)
    if hinge and np.ptp(values) > 2 * np.pi:
        return None
    middle, half = (values.max() + values.min()) / 2, max(np.ptp(values) / 2, _LEAST)
    return float(middle - margin * half), float(middle + margin * half)
