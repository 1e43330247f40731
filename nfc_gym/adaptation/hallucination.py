"""pi_h beside pi: one action distribution for both, as `Hallucinate` widens the action.

The paper's hallucinated policy chooses, within the posterior's uncertainty, the world in which pi is trained; both are
optimised for the same return. Here the two are one TorchRL actor, whose distribution is the product of the agent's own
and a Gaussian over pi_h, so that any loss that takes an actor trains both at once. What the agent's own part learns is
the agent's: its modules are used, not copied.
"""

from typing import Any

import torch
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torch.distributions import Distribution, constraints
from torchrl.data import Composite, Unbounded
from torchrl.modules import IndependentNormal, SafeProbabilisticModule, SafeProbabilisticTensorDictSequential
from torchrl.modules.distributions import has_analytic_entropy

from nfc_gym.adaptation.network import Gaussian, Scale
from nfc_gym.core.errors import InputError

_LAYERS = (64,)
_KEYS = ("h_loc", "h_scale")
_DRAWS = 4  # that an entropy without a closed form is estimated from


class Joined(Distribution):
    """Product of an agent's distribution over its action and a Gaussian over pi_h: (..., k) and (..., m) side by side.

    Args:
      own_class, own_kwargs: of the agent's distribution.
      h_loc, h_scale: (..., m).
      parameters: of the agent's distribution.
    """

    def __init__(
        self, own_class: Any, own_kwargs: dict[str, Any], h_loc: Tensor, h_scale: Tensor, **parameters: Tensor
    ) -> None:
        self.own = own_class(**parameters, **own_kwargs)
        self.h = IndependentNormal(h_loc, h_scale, tanh_loc=False)
        self.size = self.own.event_shape[-1]
        super().__init__(self.own.batch_shape, torch.Size([self.size + h_loc.shape[-1]]), validate_args=False)

    @property
    def arg_constraints(self) -> dict[str, Any]:
        """None: the two parts check their own."""
        return {}

    @property
    def support(self) -> Any:
        """All vectors."""
        return constraints.real_vector

    @property
    def has_rsample(self) -> bool:  # type: ignore[override]
        """Of the agent's own."""
        return self.own.has_rsample

    @property
    def mean(self) -> Tensor:
        """(..., k + m)."""
        return self.deterministic_sample

    @property
    def mode(self) -> Tensor:
        """(..., k + m)."""
        return self.deterministic_sample

    @property
    def deterministic_sample(self) -> Tensor:
        """What the agent does without exploring, and the mean of pi_h."""
        for name in ("deterministic_sample", "mean", "mode"):
            value = getattr(self.own, name, None)
            if isinstance(value, Tensor):
                return torch.cat([value, self.h.mean], -1)
        raise NotImplementedError(f"{type(self.own).__name__} says nothing of what to do without exploring")

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """(*sample_shape, ..., k + m)."""
        shape = torch.Size(sample_shape)
        return torch.cat([self.own.sample(shape), self.h.sample(shape)], -1)

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """The same, through which gradients pass."""
        shape = torch.Size(sample_shape)
        return torch.cat([self.own.rsample(shape), self.h.rsample(shape)], -1)

    def log_prob(self, value: Tensor) -> Tensor:
        """(...) of both together."""
        return self.own.log_prob(value[..., : self.size]) + self.h.log_prob(value[..., self.size :])

    def entropy(self) -> Tensor:
        """(...) of both together; the agent's own is estimated from draws where it has no closed form.

        TorchRL asks the class whether it has one, and of this class alone the agent's own decides.
        """
        if has_analytic_entropy(self.own):
            return self.own.entropy() + self.h.entropy()
        shape = torch.Size([_DRAWS])
        drawn = self.own.rsample(shape) if self.own.has_rsample else self.own.sample(shape)
        return self.h.entropy() - self.own.log_prob(drawn).mean(0)


def hallucination(observation: int, size: int) -> Gaussian:
    """An untrained pi_h, (..., observation) -> (..., size): the posterior's mean, and some of its spread around it."""
    return Gaussian(Scale(observation), _LAYERS, size)


def widened(actor: ProbabilisticTensorDictSequential, pi_h: Gaussian) -> ProbabilisticTensorDictSequential:
    """One actor of an agent's and pi_h: `observation` -> `action` (..., k + m) and its density.

    Args:
      actor: the agent's; its last part makes a distribution over `action`.
      pi_h: sees `observation`.

    Raises:
      InputError: it is no TorchRL actor with a density.
    """
    parts = list(actor.module) if isinstance(actor, ProbabilisticTensorDictSequential) else []
    if not parts or not isinstance(parts[-1], ProbabilisticTensorDictModule):
        raise InputError(f"hallucination needs a TorchRL actor that ends in a distribution, got {type(actor).__name__}")
    last = parts[-1]
    if next(iter(last.out_keys)) != "action":
        raise InputError(f"hallucination needs an actor whose distribution is over 'action', not {last.out_keys[0]!r}")
    keys: Any = {**dict(zip(last.dist_keys, last.in_keys, strict=True)), **{key: key for key in _KEYS}}
    joined = SafeProbabilisticModule(
        in_keys=keys,
        out_keys=["action"],
        spec=_spec(actor, pi_h),
        distribution_class=Joined,
        distribution_kwargs={"own_class": last.distribution_class, "own_kwargs": dict(last.distribution_kwargs)},
        return_log_prob=True,
        default_interaction_type=last.default_interaction_type,
    )
    beside = TensorDictModule(pi_h, in_keys=["observation"], out_keys=list(_KEYS))
    modules: list[Any] = [*parts[:-1], beside, joined]
    return SafeProbabilisticTensorDictSequential(*modules)


def _spec(actor: ProbabilisticTensorDictSequential, pi_h: Gaussian) -> Composite | None:
    """Of the longer action, for losses that read its size there; None where the agent's own actor has no spec."""
    own = getattr(actor, "spec", None)
    action = own.get("action", None) if isinstance(own, Composite) else own
    return None if action is None else Composite(action=Unbounded(torch.Size([action.shape[-1] + len(pi_h.log_std)])))
