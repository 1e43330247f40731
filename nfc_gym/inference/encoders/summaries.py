"""Physics summaries of a window: what accelerations depend on, by regression, joint by joint."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nfc_gym.core.errors import InputError
from nfc_gym.inference.encoders.base import Encoder, Standard

_CHUNK = 1024
_MOST = 16  # unknowns: a CUDA graph held the solver of 14 and not of 23
RIDGE = 1e-3  # of the regressors' mean square: what the window does not excite gets a coefficient near 0


@dataclass(frozen=True)
class Regressions:
    """Which entries of state and action each regression uses.

    Attributes:
      target: (r) states whose step s_{t+1} - s_t is explained: joint velocities, or any other.
      states: (r, p) states that explain it: the joint's velocity and position.
      actions: (r, q) actions that explain it: the joint's torque or command.
    """

    target: tuple[int, ...]
    states: tuple[tuple[int, ...], ...]
    actions: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, layout: Mapping[str, Any] | None, states: int, actions: int) -> "Regressions":
        """From a layout {"velocity": (j) indices, "position": (j) indices, "action": (j) indices} of joints.

        Without one, each state's step is explained by itself and by all actions, which needs no knowledge of the robot.

        Raises:
          InputError: the lists differ in length or an index does not exist.
        """
        if layout is None:
            every = tuple(range(states))
            return cls(every, tuple((i,) for i in every), (tuple(range(actions)),) * states)
        rows: dict[str, Sequence[int]] = {k: tuple(layout.get(k, ())) for k in ("velocity", "position", "action")}
        sizes = {k: len(v) for k, v in rows.items()}
        if not sizes["velocity"] or any(n not in (0, sizes["velocity"]) for n in sizes.values()):
            raise InputError(f"physics summaries: one velocity, position and action a joint, got {sizes}")
        for name, most in (("velocity", states), ("position", states), ("action", actions)):
            wrong = [i for i in rows[name] if not 0 <= i < most]
            if wrong:
                raise InputError(f"physics summaries: {name} {wrong[0]} does not exist; there are {most}")
        pairs = [tuple(p) for p in zip(*(rows[k] for k in ("velocity", "position") if rows[k]), strict=True)]
        return cls(tuple(rows["velocity"]), tuple(pairs), tuple((i,) for i in rows["action"]) or ((),) * len(pairs))


class Summaries(Encoder):
    """Ridge regressions of each joint's acceleration on torque, velocity and position, over the window.

    The features are the coefficients, the intercept, the logarithm of the residual's spread, and mean and spread of
    every state and action; standardised, and compressed by asinh since coefficients of what barely moved have long
    tails. On an Ant they carry as much about psi as learned features.

    Args:
      horizon: H.
      states: s.
      actions: a.
      regressions: what explains what; default each step by its own state and all actions.
    """

    of_target: Tensor
    of_states: Tensor
    of_actions: Tensor

    def __init__(self, horizon: int, states: int, actions: int, regressions: Regressions | None = None) -> None:
        super().__init__()
        self.plan = regressions or Regressions.of(None, states, actions)
        self.inputs = Standard(states + actions)
        self.outputs = Standard(states)
        per = len(self.plan.states[0]) + len(self.plan.actions[0]) + 2
        self.features = per * len(self.plan.target) + 2 * (states + actions)
        self.waits = per - 1 > _MOST  # the spread is no unknown
        self.scale = Standard(self.features)
        for name in ("target", "states", "actions"):  # on the device: lists would be sent there with every batch
            index = torch.tensor(getattr(self.plan, name), dtype=torch.long)
            self.register_buffer(f"of_{name}", index, persistent=False)

    def fit(self, states: Tensor, actions: Tensor, elevation: Tensor | None) -> None:
        """Scales of regressors, steps and features."""
        if actions.shape[1] == 0:
            raise InputError("physics summaries: a window needs at least one step")
        self.inputs.fit(torch.cat([states[:, :-1], actions], -1))
        self.outputs.fit(states.diff(dim=1))
        parts = zip(states.split(_CHUNK), actions.split(_CHUNK), strict=True)  # regressors take H times the room
        self.scale.fit(torch.cat([self.raw(s, a) for s, a in parts]))

    def forward(self, states: Tensor, actions: Tensor, elevation: Tensor | None = None) -> Tensor:
        """(B, features)."""
        return self.scale(self.raw(states, actions)).clamp(-10, 10)

    def raw(self, states: Tensor, actions: Tensor) -> Tensor:
        """(B, features) before they are standardised; in double, whatever the products of networks are rounded to."""
        with torch.autocast(states.device.type, enabled=False):
            x = self.inputs(torch.cat([states[:, :-1], actions], -1).double())
            y = self.outputs(states.double().diff(dim=1))
            s, r = states.shape[-1], len(self.plan.target)
            chosen = [x[..., self.of_states]]  # (B, H, r, p)
            if self.plan.actions[0]:
                chosen.append(x[..., s + self.of_actions])
            design = torch.cat([*chosen, x.new_ones(*x.shape[:2], r, 1)], -1).movedim(2, 1)  # (B, r, H, p)
            target = y[..., self.of_target].mT[..., None]  # (B, r, H, 1)
            gram = design.mT @ design / design.shape[-2]
            power = gram.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
            eye = torch.eye(gram.shape[-1], dtype=x.dtype, device=x.device)
            # The ridge leaves nothing singular, so that no GPU need be waited for to ask.
            weights = torch.linalg.solve_ex(gram + RIDGE * power * eye, design.mT @ target / design.shape[-2])[0]
            spread = (target - design @ weights).square().mean((-2, -1)).add(1e-12).log() / 2
            moments = torch.cat([x.mean(1), x.std(1, correction=0)], -1)
            return torch.cat([weights.flatten(1).asinh(), spread, moments], -1).float()
