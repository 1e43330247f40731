"""The baseline of a learned residual: a small network from state and command to the force that psi leaves over.

As in residual-dynamics learning (ASAP, for one): no law and no name, only a better prediction. It acts in the same
roll-outs as a generalised force at every physics step; the base's translation is seen and answered in its own frame.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from nfc_gym.core.log import Log
from nfc_gym.measured.bench import Bench
from nfc_gym.measured.hidden import Array
from nfc_gym.physics.effects.base import Context, Effect, Forces
from nfc_gym.physics.rollout import Plant
from nfc_gym.physics.state import rotate, rotate_back

from .residual import Leftover, leftover

_WIDTH, _EPOCHS, _BATCH, _PATIENCE = 64, 150, 512, 20
_WILD = 8.0  # median absolute forces beyond which a sample counts as this many: touch-downs outrun the logs


class Learned(Effect):
    """A network's force; weights as (matrix, bias) of each layer, tanh between them."""

    family = "learned"
    summary = "Learned residual"
    generic = True

    def __init__(self, weights: Sequence[tuple[Array, Array]], scale: tuple[Array, Array, Array]) -> None:
        super().__init__(("world",))
        self.weights, (self.middle, self.spread, self.size) = weights, scale

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        """See `Effect`."""
        h = (inputs(ctx.model, ctx.q, ctx.v, ctx.ctrl) - self.middle) / self.spread
        for i, (matrix, bias) in enumerate(self.weights):
            h = h @ matrix.T + bias
            h = np.tanh(h) if i + 1 < len(self.weights) else h
        force = np.clip(h, -_WILD, _WILD) * self.size
        force[..., :3] = rotate(ctx.q[..., 3:7], force[..., :3])
        out.qfrc += force


def inputs(model: mujoco.MjModel, q: Array, v: Array, ctrl: Array) -> Array:
    """(..., k): height, which way is up, own velocity and rate of a free base; joints' angles, speeds; commands."""
    down = np.broadcast_to([0.0, 0.0, 1.0], (*q.shape[:-1], 3))
    up, own = rotate_back(q[..., 3:7], down), rotate_back(q[..., 3:7], v[..., :3])
    angles = q[..., 7:].copy()
    turning = [
        int(a) - 7 for a, limited in zip(model.jnt_qposadr[1:], model.jnt_limited[1:], strict=True) if not limited
    ]
    angles[..., turning] = np.sin(angles[..., turning])  # wheels turn without end
    return np.concatenate([q[..., 2:3], up, own, v[..., 3:6], angles, v[..., 6:], ctrl], -1)


def learn(
    bench: Bench, fitting: Sequence[Log], selecting: Sequence[Log], plant: Plant, x: Array, seed: int
) -> tuple[Plant, Array]:
    """The calibrated model x (size,) with a network fitted to the fit logs; the selection logs say when to stop."""
    import torch

    torch.set_num_threads(1)
    torch.manual_seed(seed % 2**31)
    parts = [leftover(bench, logs, plant, x) for logs in (fitting, selecting)]
    features = [inputs(plant.model, d.qpos, d.qvel, d.ctrl) for d in parts]
    targets = [_own(d) for d in parts]
    middle, spread = features[0].mean(0), np.maximum(features[0].std(0), 1e-6)
    size = np.maximum(1.4826 * np.median(np.abs(targets[0]), 0), 1e-9)
    tensor = lambda a: torch.tensor(a, dtype=torch.float32)  # noqa: E731
    seen, unseen = (tensor((f - middle) / spread) for f in features)
    goal, unseen_goal = (tensor(np.clip(t / size, -_WILD, _WILD)) for t in targets)
    net = torch.nn.Sequential(
        torch.nn.Linear(seen.shape[1], _WIDTH), torch.nn.Tanh(),
        torch.nn.Linear(_WIDTH, _WIDTH), torch.nn.Tanh(),
        torch.nn.Linear(_WIDTH, goal.shape[1]),
    )  # fmt: skip
    # It begins as no force at all: where nothing can be learned that holds on unseen logs, nothing is added.
    torch.nn.init.zeros_(net[-1].weight)
    torch.nn.init.zeros_(net[-1].bias)
    optimizer = torch.optim.AdamW(net.parameters(), lr=2e-3, weight_decay=1e-2)
    best, kept, waited = float((unseen_goal**2).mean()), _weights(net), 0
    for _ in range(_EPOCHS):
        for rows in torch.randperm(len(seen)).split(_BATCH):
            optimizer.zero_grad()
            ((net(seen[rows]) - goal[rows]) ** 2).mean().backward()
            optimizer.step()
        with torch.no_grad():
            loss = float(((net(unseen) - unseen_goal) ** 2).mean())
        waited += 1
        if loss < best:
            best, kept, waited = loss, _weights(net), 0
        if waited > _PATIENCE:
            break
    return bench.plant.with_effects([Learned(kept, (middle, spread, size))]), x


def _own(d: Leftover) -> Array:
    """Forces with the base's translation in its own frame."""
    force = d.force.copy()
    force[:, :3] = rotate_back(d.qpos[:, 3:7], force[:, :3])
    return force


def _weights(net: object) -> list[tuple[Array, Array]]:
    """(matrix, bias) of each linear layer, copied."""
    layers = [m for m in net if hasattr(m, "weight")]  # type: ignore[attr-defined]
    return [(m.weight.detach().numpy().astype(float), m.bias.detach().numpy().astype(float)) for m in layers]
