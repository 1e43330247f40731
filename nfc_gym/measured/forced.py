"""Where a force of unknown course would explain most: the evidence of each joint, over the impulse tensor.

What no law says, a load that slides about or a joint that sticks, still acts somewhere. If the forces on a joint are
independent normal numbers of one spread, they give what is left a covariance; its marginal likelihood at the best
spread, over that of no force at all, says how well. A free joint's six forces are no advantage in themselves: whatever
they could have done besides counts against them.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from nfc_gym.measured.impulse import Tensor
from nfc_gym.physics.effects.base import Array

_SPREADS = 10.0 ** np.arange(-2.0, 1.6, 0.25)  # of the forces, in realistic ones
SURE = 12.0  # nats by which the best place must lead: an Ant's wrong one has led by 10


def forced(model: mujoco.MjModel, tensor: Tensor, sizes: dict[int, float], rest: Array) -> dict[str, float]:
    """Evidence of a force on each joint.

    Args:
      model: names the joints.
      tensor: weighted as the rest is.
      sizes: dof -> a realistic force there.
      rest: (S, m) what is left, whitened.

    Returns:
      joint -> nats over no force at all, largest first. Empty where what is compared answers a force at its own
      instant alone, and shows its place by itself.
    """
    if tensor.pointwise:
        return {}
    joints: dict[int, list[int]] = {}
    for at, dof in enumerate(tensor.dofs):
        joints.setdefault(int(model.dof_jntid[dof]), []).append(at)
    out = {
        mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint): _evidence(tensor, sizes, at, rest)
        for joint, at in joints.items()
    }
    return dict(sorted(out.items(), key=lambda kv: -kv[1]))


def surest(evidence: dict[str, float]) -> str | None:
    """The joint whose evidence leads clearly, or None."""
    (best, most), *others = [*evidence.items()] or [("", 0.0)]
    return best if most - max([0.0, *(e for _, e in others)]) >= SURE else None


def _evidence(tensor: Tensor, sizes: dict[int, float], at: Sequence[int], rest: Array) -> float:
    unit = np.array([sizes[tensor.dofs[i]] for i in at])
    answer = (tensor.answer[:, at] * unit[:, None, None]).reshape(len(rest), -1, rest.shape[1])
    _, singular, along = np.linalg.svd(answer, full_matrices=False)
    seen = np.einsum("skm,sm->sk", along, rest) ** 2
    more = _SPREADS[:, None, None] ** 2 * singular**2
    return float(0.5 * (seen * more / (1 + more) - np.log1p(more)).sum((1, 2)).max())
