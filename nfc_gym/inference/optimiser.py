"""Muon for the matrices of a network and AdamW for the rest, as steps that a CUDA graph can hold."""

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn, optim

_QUINTIC = (3.4445, -4.7750, 2.0315)  # Jordan et al. 2024: steep at 0, so that five rounds do for small singular values
_ROUNDS = 5
_MOMENTUM = 0.95
# Root mean square of an entry of a step over the step size. AdamW's have 1 at first and 0.2 in long runs (Liu et al.
# 2025); with a third of this, posteriors of an Ant learned less in as many steps.
_RMS = 0.6
_WIDEST = 512  # of a matrix's smaller side: a larger one would cost a processor many times what the rest of a step does


def orthogonal(matrices: Tensor) -> Tensor:
    """(k, m, n) matrices with their singular values brought near 1, by Newton and Schulz.

    Those above three thousandths of a matrix's norm come to 0.68 to 1.2, one of a thousandth to half.
    A gradient of a layer has few large singular values. What it says of the other directions, by which narrow
    posteriors are told from one another, is lost in a step as large as those allow.
    """
    a, b, c = _QUINTIC
    tall = matrices.shape[1] > matrices.shape[2]
    x = matrices.mT if tall else matrices
    x = x / x.norm(dim=(1, 2), keepdim=True).clamp(min=1e-30)
    for _ in range(_ROUNDS):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
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
        for group in self.param_groups:
            params = [p for p in group["params"] if p.grad is not None]
            rate = group["lr"] * (1 - self.lost)
            changes = _orthogonal_all([g.flatten(1) for g in self._leaning(params)])
            torch._foreach_mul_(params, 1 - rate * group["weight_decay"])  # type: ignore[attr-defined]
            torch._foreach_mul_(changes, rate)  # type: ignore[attr-defined]
            torch._foreach_sub_(params, [c.view_as(p) for c, p in zip(changes, params, strict=True)])  # type: ignore[attr-defined]

    def _leaning(self, params: list[nn.Parameter]) -> list[Tensor]:
        """Gradients, leaning towards their momentum, which follows them (Nesterov)."""
        for p in params:
            if "momentum" not in self.state[p]:
                self.state[p]["momentum"] = torch.zeros_like(p)
        momenta = [self.state[p]["momentum"] for p in params]
        # Where all is lost the gradient may be no number, and the momentum stays.
        fine = self.lost == 0
        gradients = [torch.where(fine, p.grad, m) for p, m in zip(params, momenta, strict=True)]  # type: ignore[arg-type]
        torch._foreach_lerp_(momenta, gradients, 1 - _MOMENTUM)  # type: ignore[attr-defined]
        return list(torch._foreach_lerp(gradients, momenta, _MOMENTUM))  # type: ignore[attr-defined]


def _orthogonal_all(matrices: list[Tensor]) -> list[Tensor]:
    """Each made orthogonal, with entries of `_RMS` in root mean square.

    A GPU takes the time of a kernel for a small matrix: those of about one size are filled up with zeros, which stay
    zeros, and done together.
    """
    alike: dict[tuple[int, int], list[int]] = {}
    gpu = matrices[0].is_cuda if matrices else False
    for i, matrix in enumerate(matrices):
        alike.setdefault((_class(min(matrix.shape), gpu), _class(max(matrix.shape), gpu)), []).append(i)
    out = list(matrices)
    for members in alike.values():
        wide = [matrices[i].mT if _tall(matrices[i]) else matrices[i] for i in members]
        m, n = (max(w.shape[k] for w in wide) for k in (0, 1))
        done = orthogonal(torch.stack([nn.functional.pad(w, (0, n - w.shape[1], 0, m - w.shape[0])) for w in wide]))
        for i, w, whole in zip(members, wide, done, strict=True):
            part = whole[: w.shape[0], : w.shape[1]] * (_RMS * math.sqrt(max(w.shape)))
            out[i] = (part.mT if _tall(matrices[i]) else part).contiguous()
    return out


def _tall(matrix: Tensor) -> bool:
    return matrix.shape[0] > matrix.shape[1]


def _class(size: int, gpu: bool) -> int:
    """The next power of two as exponent, on a GPU the next of four: it has less to launch, though more to multiply."""
    bits = (size - 1).bit_length()
    return (bits + 1) // 2 if gpu else bits


class Optimiser:
    """Both as one: `Muon` for matrices and kernels, AdamW for the rest.

    That is biases, matrices with more than 512 inputs and more than 512 outputs, and all where there is no Muon.

    Args:
      network: on its device.
      rate: step size before the first step.
      decay: of the weights.
      lost: () on that device: 1 from when on nothing is to be changed.
      muon: whether matrices are Muon's.
    """

    def __init__(self, network: nn.Module, rate: float, decay: float, lost: Tensor, muon: bool = True) -> None:
        params = [p for p in network.parameters() if p.requires_grad]
        suits = [muon and p.ndim > 1 and min(p.shape[0], p[0].numel()) <= _WIDEST for p in params]
        matrices, rest = ([p for p, fit in zip(params, suits, strict=True) if fit is want] for want in (True, False))
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
            part.load_state_dict(state)
            for group in part.param_groups:  # where loading has put a copy
                group["lr"] = self.rate
