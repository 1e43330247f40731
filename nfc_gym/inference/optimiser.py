"""Muon for the matrices of a network and AdamW for the rest, as steps that a CUDA graph can hold."""

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn, optim

_QUINTIC = (3.4445, -4.7750, 2.0315)  # Jordan et al. 2024: steep at 0, so that five rounds do for small singular values
_ROUNDS = 5
_MOMENTUM = 0.95
_RMS = 0.2  # root mean square of an entry of AdamW's steps (Liu et al. 2025), so that one step size does for both


def orthogonal(matrices: Tensor) -> Tensor:
    """(..., m, n) matrices with all their singular values brought near 1 (0.7 to 1.2), by Newton and Schulz.

    A gradient of a layer has few large singular values. What it says of the other directions, by which narrow
    posteriors are told from one another, is lost in a step as large as those allow.
    """
    a, b, c = _QUINTIC
    tall = matrices.shape[-2] > matrices.shape[-1]
    x = matrices.mT if tall else matrices
    x = x / x.norm(dim=(-2, -1), keepdim=True).clamp(min=1e-30)
    for _ in range(_ROUNDS):
        gram = x @ x.mT
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x.mT if tall else x


class Muon(optim.Optimizer):
    """Momentum, its matrices orthogonalised (Jordan et al. 2024, "Muon: an optimizer for hidden layers").

    torch's own takes no step size that lies on the device, as a captured step wants it, and no convolutions: here
    their kernels are matrices of outputs times all that they see.

    Args:
      params: of two axes or more, the first of which is a layer's outputs.
      rate: () step size on the device of the parameters, as of AdamW.
      decay: of the weights.
      lost: (), 1 from when on nothing is to be changed.
    """

    def __init__(self, params: Iterable[nn.Parameter], rate: Tensor, decay: float, lost: Tensor) -> None:
        super().__init__(params, {"lr": rate, "weight_decay": decay})
        self.lost = lost

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """One step; the gradients are there, and no closure is called."""
        kept = 1 - self.lost
        for group in self.param_groups:
            alike: dict[tuple[int, ...], list[nn.Parameter]] = {}
            for p in group["params"]:
                if p.grad is not None:
                    alike.setdefault((p.shape[0], p[0].numel()), []).append(p)
            for (m, n), params in alike.items():
                now = torch.stack([self._leaning(p, kept).flatten(1) for p in params])
                steps = orthogonal(now) * (_RMS * math.sqrt(max(m, n)) * kept * group["lr"])
                stay = 1 - kept * group["lr"] * group["weight_decay"]
                for p, change in zip(params, steps, strict=True):
                    p.mul_(stay).sub_(change.view_as(p))

    def _leaning(self, p: nn.Parameter, kept: Tensor) -> Tensor:
        """The gradient, leaning towards the momentum, which follows it (Nesterov)."""
        assert p.grad is not None  # the caller has asked
        gradient = torch.where(self.lost == 0, p.grad, 0.0)
        if "momentum" not in self.state[p]:
            self.state[p]["momentum"] = torch.zeros_like(p)
        momentum = self.state[p]["momentum"]
        momentum.lerp_(gradient, (1 - _MOMENTUM) * kept)
        return gradient.lerp(momentum, _MOMENTUM)


class Optimiser:
    """Both as one: `Muon` for what has two axes or more, AdamW for the rest and for all where there is no Muon.

    Args:
      network: on its device.
      rate: step size before the first step.
      decay: of the weights.
      lost: () on that device: 1 from when on nothing is to be changed.
      muon: whether matrices are Muon's.
    """

    def __init__(self, network: nn.Module, rate: float, decay: float, lost: Tensor, muon: bool = True) -> None:
        params = [p for p in network.parameters() if p.requires_grad]
        matrices = [p for p in params if p.ndim > 1] if muon else []
        rest = [p for p in params if p.ndim <= 1 or not muon]
        self.rate = torch.full((), rate, device=lost.device)
        self.parts: list[optim.Optimizer] = []
        if rest:
            adam = optim.AdamW(rest, self.rate, weight_decay=decay, fused=True, capturable=lost.is_cuda)
            adam.found_inf = lost  # type: ignore[attr-defined] (as torch's GradScaler)
            self.parts.append(adam)
        if matrices:
            self.parts.append(Muon(matrices, self.rate, decay, lost))

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for part in self.parts:
            part.zero_grad(set_to_none=True)

    def step(self) -> None:
        """Change the parameters by their gradients."""
        for part in self.parts:
            part.step()

    def tensors(self) -> dict[str, Tensor]:
        """What it would need to go on, by names that `load` knows."""
        return {
            f"{k}/{i}/{name}": value
            for k, part in enumerate(self.parts)
            for i, entry in part.state_dict()["state"].items()
            for name, value in entry.items()
        }

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Set it to where `tensors` were taken."""
        states = [part.state_dict() for part in self.parts]
        for key, value in tensors.items():
            k, i, name = key.split("/")
            states[int(k)]["state"].setdefault(int(i), {})[name] = value
        for part, state in zip(self.parts, states, strict=True):
            for group in state["param_groups"]:
                group["lr"] = self.rate
            part.load_state_dict(state)
            for group in part.param_groups:  # which loading replaces by a copy
                group["lr"] = self.rate
