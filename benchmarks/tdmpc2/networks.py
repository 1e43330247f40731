"""Layers of TD-MPC2: simplicial normalisation, normed layers, critics side by side, two-hot regression."""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

WEIGHTS = 0.02  # standard deviation of first weights


def symlog(x: Tensor) -> Tensor:
    """sign(x) log(1 + |x|): returns of any size, brought to the same range."""
    return x.sign() * x.abs().log1p()


def symexp(x: Tensor) -> Tensor:
    """The inverse of `symlog`."""
    return x.sign() * x.abs().expm1()


class TwoHot(nn.Module):
    """Numbers as weights on the two nearest of evenly spaced bins in symlog space; regression by cross-entropy.

    Args:
      bins: how many.
      bound: the outermost lie at -bound and bound; what is larger is cut there.
    """

    centres: Tensor
    places: Tensor

    def __init__(self, bins: int, bound: float) -> None:
        super().__init__()
        self.bound = bound
        self.register_buffer("centres", torch.linspace(-bound, bound, bins), persistent=False)
        self.register_buffer("places", torch.arange(float(bins)), persistent=False)

    def encode(self, x: Tensor) -> Tensor:
        """(...) -> (..., bins), each row at most two weights that sum to one."""
        gap = 2 * self.bound / (len(self.places) - 1)
        place = (symlog(x).clamp(-self.bound, self.bound) + self.bound) / gap
        return (1 - (place[..., None] - self.places).abs()).clamp(min=0)

    def decode(self, logits: Tensor) -> Tensor:
        """(..., bins) -> (...): the mean in symlog space, brought back."""
        return symexp((logits.softmax(-1) * self.centres).sum(-1))

    def loss(self, logits: Tensor, x: Tensor) -> Tensor:
        """Cross-entropy (...) of logits (..., bins) with numbers (...)."""
        return -(self.encode(x) * logits.log_softmax(-1)).sum(-1)


class SimNorm(nn.Module):
    """Softmax within groups of the last dimension, so that each group is a point of a simplex (paper, eq. 5)."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.size = size

    def forward(self, x: Tensor) -> Tensor:
        """(..., n) with n a multiple of the group's size."""
        return x.unflatten(-1, (-1, self.size)).softmax(-1).flatten(-2)


class NormedLinear(nn.Sequential):
    """A linear layer, layer normalisation, and what follows them: Mish where nothing else is named."""

    def __init__(self, inputs: int, outputs: int, after: nn.Module | None = None) -> None:
        super().__init__(nn.Linear(inputs, outputs), nn.LayerNorm(outputs), after or nn.Mish())


def perceptron(inputs: int, hidden: tuple[int, ...], outputs: int, after: nn.Module | None = None) -> nn.Sequential:
    """Normed layers, the last one linear alone or, with `after`, normed too; first weights small, biases zero."""
    sizes = (inputs, *hidden)
    layers: list[nn.Module] = [NormedLinear(a, b) for a, b in pairwise(sizes)]
    layers.append(NormedLinear(sizes[-1], outputs, after) if after else nn.Linear(sizes[-1], outputs))
    made = nn.Sequential(*layers)
    for module in made.modules():
        if isinstance(module, nn.Linear):
            nn.init.trunc_normal_(module.weight, std=WEIGHTS)
            nn.init.zeros_(module.bias)
    return made


class _Layer(nn.Module):
    """One linear layer of each of k networks, with a layer normalisation and Mish behind it unless it is the last."""

    def __init__(self, count: int, inputs: int, outputs: int, dropout: float, last: bool) -> None:
        super().__init__()
        self.weight = nn.Parameter(nn.init.trunc_normal_(torch.empty(count, inputs, outputs), std=WEIGHTS))
        self.bias = nn.Parameter(torch.zeros(count, 1, outputs))
        self.dropout, self.last = dropout, last
        if last:
            nn.init.zeros_(self.weight)
        else:
            self.gain = nn.Parameter(torch.ones(count, 1, outputs))
            self.shift = nn.Parameter(torch.zeros(count, 1, outputs))

    def forward(self, x: Tensor, chosen: Tensor | None, frozen: bool) -> Tensor:
        def of(parameter: Tensor) -> Tensor:
            given = parameter.detach() if frozen else parameter
            return given if chosen is None else given[chosen]

        y = torch.baddbmm(of(self.bias), x, of(self.weight))
        if self.last:
            return y
        y = F.dropout(y, self.dropout, self.training)
        return F.mish(F.layer_norm(y, y.shape[-1:]) * of(self.gain) + of(self.shift))


class Critics(nn.Module):
    """k networks of one shape, evaluated together; the first outputs are all zero.

    Args:
      count: k.
      inputs, hidden, outputs: sizes.
      dropout: in the first layer.
    """

    def __init__(self, count: int, inputs: int, hidden: tuple[int, ...], outputs: int, dropout: float) -> None:
        super().__init__()
        self.count = count
        sizes = (inputs, *hidden, outputs)
        self.layers = nn.ModuleList(
            _Layer(count, a, b, dropout if i == 0 else 0.0, i == len(sizes) - 2)
            for i, (a, b) in enumerate(pairwise(sizes))
        )

    def forward(self, x: Tensor, chosen: Tensor | None = None, frozen: bool = False) -> Tensor:
        """(..., inputs) -> (k, ..., outputs).

        Args:
          x: what all of them see.
          chosen: indices of those that are wanted; None is all.
          frozen: no gradient reaches the weights, only what is seen.
        """
        count = self.count if chosen is None else len(chosen)
        y = x.reshape(-1, x.shape[-1]).expand(count, -1, -1)
        for layer in self.layers:
            y = layer(y, chosen, frozen)
        return y.unflatten(1, x.shape[:-1])
