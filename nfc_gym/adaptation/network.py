"""Actor and critic: perceptrons over observations that a running mean and variance bring to one scale."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator

from nfc_gym.core.errors import InputError

# Hidden layers by name; `paper` is the paper's MLP [1024, 512, a].
NETS: dict[str, tuple[int, ...]] = {"paper": (1024, 512), "small": (256, 128)}
CLIP = 5.0  # standard deviations beyond which an observation is cut: a blow of contact, a fall
_FIRST = 0.6  # standard deviation of an untrained policy's actions, of a range of one either way


def hidden_of(net: str) -> tuple[int, ...]:
    """Hidden layers of a named network; another name raises `InputError`."""
    if net not in NETS:
        raise InputError(f"--net {net!r}: want one of: {', '.join(NETS)}")
    return NETS[net]


class Scale(nn.Module):
    """Brings observations (..., size) to mean 0 and variance 1, of all that it was shown.

    Attributes:
      mean, var: (size,) of what was seen.
      count: how many observations.
    """

    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("var", torch.ones(size))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @property
    def spread(self) -> Tensor:
        """(size,) by which observations are divided."""
        return (self.var + 1e-4).sqrt()

    def forward(self, x: Tensor) -> Tensor:
        """(..., size)."""
        return ((x - self.mean) * torch.rsqrt(self.var + 1e-4)).clamp(-CLIP, CLIP)

    @torch.no_grad()
    def begin(self, x: Tensor, known: int) -> None:
        """Take mean and variance of the entries from `known` on from observations (..., size) alone."""
        x = x.reshape(-1, x.shape[-1])[:, known:].double()
        self.mean[known:], self.var[known:] = x.mean(0).float(), x.var(0, unbiased=False).float()

    @torch.no_grad()
    def see(self, x: Tensor) -> None:
        """Take observations (..., size) into mean and variance, by Chan's rule for joining two sets."""
        x = x.reshape(-1, x.shape[-1]).double()
        n, total = len(x), self.count + len(x)
        gap = x.mean(0) - self.mean
        within = self.var * self.count + x.var(0, unbiased=False) * n
        self.var.copy_((within + gap**2 * self.count * n / total) / total)
        self.mean.add_(gap * n / total)
        self.count.fill_(total)


def perceptron(sizes: Sequence[int], last: float) -> nn.Sequential:
    """Linear layers with ELU between them; the first weights of the last one are scaled by `last`."""
    layers: list[nn.Module] = []
    for i, (a, b) in enumerate(pairwise(sizes)):
        linear = nn.Linear(a, b)
        nn.init.orthogonal_(linear.weight, 2**0.5 if i < len(sizes) - 2 else last)
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.ELU()]
    return nn.Sequential(*layers[:-1])


class Gaussian(nn.Module):
    """Mean and spread of the actions: the mean is kept in [-1, 1] by tanh, the spread does not depend on the state.

    Actions beyond [-1, 1] are cut by the environment; what the learner sees is the Gaussian that they were drawn from,
    whose density has no edge.

    Args:
      scale: of the observation.
      hidden: sizes of the layers.
      size: of the action.
    """

    def __init__(self, scale: Scale, hidden: Sequence[int], size: int) -> None:
        super().__init__()
        self.scale = scale
        self.body = perceptron((len(scale.mean), *hidden, size), 0.01)
        self.log_std = nn.Parameter(torch.full((size,), _FIRST).log())

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """(..., size) mean and standard deviation."""
        mean = torch.tanh(self.body(self.scale(observation)))
        return mean, self.log_std.clamp(-3.0, 0.5).exp().expand_as(mean)


class Value(nn.Module):
    """What the return will be, from the observation and the psi that is simulated."""

    def __init__(self, scale: Scale, psi: int, hidden: Sequence[int]) -> None:
        super().__init__()
        self.scale = scale
        self.body = perceptron((len(scale.mean) + psi, *hidden, 1), 1.0)

    def forward(self, observation: Tensor, psi: Tensor) -> Tensor:
        """(..., 1)."""
        return self.body(torch.cat([self.scale(observation), psi], -1))


@dataclass(frozen=True)
class Sizes:
    """Of an actor and a critic: observation, psi, action, hidden layers."""

    observation: int
    psi: int
    action: int
    hidden: tuple[int, ...]


class ActorCritic(nn.Module):
    """A policy and its critic as TorchRL modules.

    Attributes:
      scale: of the observations, of both.
      actor: `observation` -> `loc`, `scale`, `action`, its log density.
      critic: `observation`, `psi` -> `state_value`.
    """

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.scale = Scale(sizes.observation)
        self.gaussian = Gaussian(self.scale, sizes.hidden, sizes.action)
        self.value = Value(self.scale, sizes.psi, sizes.hidden)

    @property
    def actor(self) -> ProbabilisticActor:
        """Shares its weights with this module."""
        return actor_of(self.gaussian)

    @property
    def critic(self) -> ValueOperator:
        """Shares its weights with this module."""
        return ValueOperator(self.value, in_keys=["observation", "psi"])


def actor_of(module: nn.Module, **more: Any) -> ProbabilisticActor:
    """A TorchRL actor of a module from observations to mean and standard deviation."""
    return ProbabilisticActor(
        TensorDictModule(module, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        distribution_kwargs={"tanh_loc": False},
        return_log_prob=True,
        **more,
    )
