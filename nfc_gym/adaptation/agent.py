"""What `adapt` wants of an agent: a TorchRL actor, and how to make its loss. Nothing else of it is known.

    agent = Agent(actor, lambda actor, size: ClipPPOLoss(actor, critic), sight)

`ppo_agent` and `sac_agent` make one of a policy that `nfc-gym pretrain` wrote.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn.parameter import is_lazy
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ValueOperator
from torchrl.objectives import LossModule, SACLoss, SoftUpdate, ValueEstimators

from nfc_gym.adaptation.network import Scale, perceptron
from nfc_gym.adaptation.policy import Policy
from nfc_gym.adaptation.ppo import ONWARD, Actor, Diverged, OnPolicy, Power, PPOConfig, clipped, require_finite, summed
from nfc_gym.adaptation.sight import Sight
from nfc_gym.core.errors import InputError

_HORIZON = 4  # control steps of a simulation between two rounds of updates off policy
MakeLoss = Callable[[Actor, int], LossModule]


class Learner(Protocol):
    """What improves an actor from batches of steps.

    Attributes:
      loss: the TorchRL loss.
    """

    loss: LossModule

    def horizon(self, n: int) -> int:
        """Control steps that it wants of each of n simulations in a batch."""
        ...

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from steps (n, horizon); returns values to write down; raises `Diverged`."""
        ...


@dataclass(frozen=True, kw_only=True)
class OffPolicyConfig:
    """Settings of learning from a replay buffer.

    Attributes:
      gamma: discount a control step.
      capacity: steps that are kept.
      batch: steps an update.
      updates: for each batch that is collected.
      rate: step size.
      follow: share by which target networks follow an update.
      critic_first: batches from which only the critics learn: an actor that was trained before is not to be led by
        critics that know nothing.
    """

    gamma: float = 0.99
    capacity: int = 500_000
    batch: int = 1024
    updates: int = 16
    rate: float = 3e-4
    follow: float = 0.005
    critic_first: int = 20


class OffPolicy:
    """Improves an actor from all steps so far, by any loss that learns off policy (SAC, TD3, ...).

    Args:
      loss: a TorchRL loss; where it has target networks they follow slowly.
      config: see `OffPolicyConfig`.
    """

    def __init__(self, loss: LossModule, config: OffPolicyConfig) -> None:
        self.loss, self.config = loss, config
        device = next(loss.parameters()).device
        loss.make_value_estimator(ValueEstimators.TD0, gamma=config.gamma)
        has_targets = any(k.startswith("target_") for k, _ in loss.named_buffers())
        self.targets = SoftUpdate(loss, tau=config.follow) if has_targets else None
        self.optimiser = torch.optim.Adam(loss.parameters(), lr=config.rate)
        self.power = Power().to(device)
        self.buffer = ReplayBuffer(storage=LazyTensorStorage(config.capacity, device=device), batch_size=config.batch)
        self._seen = 0

    def horizon(self, n: int) -> int:
        """Short: what is new is learned from many times anyway."""
        return _HORIZON

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """See `Learner`."""
        reward = batch["next", "reward"]
        self.power(reward)
        self.buffer.extend(batch.reshape(-1))
        self._seen += 1
        rows = [self._update(self.buffer.sample()) for _ in range(self.config.updates)]
        return {"loss": float(np.mean(rows))}

    def _update(self, steps: TensorDictBase) -> float:
        steps["next", "reward"] = (1 - self.config.gamma) * steps["next", "reward"] / (self.power.value.sqrt() + 1e-8)
        losses = self.loss(steps)
        if self._seen <= self.config.critic_first:
            losses = losses.exclude("loss_actor", "loss_alpha")
        total = summed(losses)
        if not total.isfinite():
            raise Diverged(f"the loss is not finite ({float(total.detach()):g})")
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()
        require_finite(nn.utils.get_total_norm([p.grad for p in self.loss.parameters() if p.grad is not None]))
        self.optimiser.step()
        if self.targets is not None:
            self.targets.step()
        return float(total.detach())


@dataclass
class Agent:
    """A TorchRL actor and how its loss is made.

    Attributes:
      actor: `observation` -> `action`, ending in a distribution; on the device on which it is to learn.
      loss: (actor, action size) -> its TorchRL loss. The actor is the agent's own or, hallucinating, one around it
        whose action is longer: a critic of actions must be made for that size.
      sight: what `observation` is.
      on_policy, off_policy: settings of learning; which of them holds is seen from the loss.
      weights: all that is kept when a run is interrupted; None is the actor alone.
    """

    actor: Actor
    loss: MakeLoss
    sight: Sight
    on_policy: PPOConfig = field(default_factory=PPOConfig)
    off_policy: OffPolicyConfig = field(default_factory=OffPolicyConfig)
    weights: nn.Module | None = None

    def learner(self, actor: Actor, size: int) -> Learner:
        """What improves `actor`, the agent's own or one around it, whose actions have `size` entries."""
        loss = self.loss(actor, size)
        if not isinstance(loss, LossModule):
            raise InputError(f"agent: `loss` must make a TorchRL loss, and made a {type(loss).__name__}")
        _require_sized(loss, "loss")
        if hasattr(loss.tensor_keys, "advantage"):
            return OnPolicy(loss, self.on_policy)
        return OffPolicy(loss, self.off_policy)

    @property
    def device(self) -> torch.device:
        """Of the actor's weights."""
        return next(self.actor.parameters()).device

    @torch.no_grad()
    def __call__(self, observation: Any) -> NDArray[np.float32]:
        """What it does without exploring, (..., k) in [-1, 1]; observations as of `Sight.flat`."""
        flat = torch.from_numpy(np.ascontiguousarray(self.sight.flat(observation))).to(self.device)
        with _as_deployed(self.actor):
            action = self._acted(flat.reshape(-1, self.sight.size))["action"]
        return action.reshape(*flat.shape[:-1], action.shape[-1]).clamp(-1, 1).cpu().numpy()

    def _acted(self, observations: Tensor) -> TensorDictBase:
        """The actor's step for observations (n, size)."""
        return self.actor(TensorDict({"observation": observations}, observations.shape[:1]))

    def action_size(self) -> int:
        """k, from one call.

        Raises:
          InputError: the actor wants more than `observation`, its action is no continuous vector, or weights that are
            kept have no size yet.
        """
        more = [repr(k) for k in getattr(self.actor, "in_keys", ()) if k != "observation"]
        if more:
            raise InputError(
                f"agent: the actor wants {', '.join(more)}, and all that it is shown is 'observation': a recurrent "
                "one, whose memory somebody must keep, will not do"
            )
        with torch.no_grad(), _as_deployed(self.actor):
            step = self._acted(torch.zeros(1, self.sight.size, device=self.device))
            discrete = _discrete(self.actor, step)
        action = step["action"]
        if discrete or not action.is_floating_point() or action.ndim != 2:
            raise InputError(
                "agent: actions must be a continuous vector, such as of a TanhNormal; the actor gives "
                f"{action.dtype} of shape {tuple(action.shape[1:])} by its {_named(self.actor)}"
            )
        _require_sized(self.weights, "weights")
        return action.shape[1]


@contextmanager
def _as_deployed(actor: Actor) -> Iterator[None]:
    """An actor that does not explore, in evaluation mode: no dropout, no running statistics that take in what is seen.

    Each of its modules is then put back into the mode in which it was.
    """
    modes = [(module, module.training) for module in actor.modules()]
    actor.eval()
    try:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            yield
    finally:
        for module, training in modes:
            module.training = training


def _require_sized(module: nn.Module | None, where: str) -> None:
    """Refuse lazy layers that nothing was shown yet: what has no size can neither be kept nor learn."""
    lazy = [] if module is None else [n for n, p in module.named_parameters() if is_lazy(p)]
    if lazy:
        raise InputError(
            f"agent: {lazy[0]!r} of its `{where}` has no size yet: call actor and critic once, for instance on zeros "
            "of the observation's size, or say `in_features`"
        )


def _discrete(actor: Actor, step: TensorDictBase) -> bool:
    """Whether a step's distribution is over a choice of some, as far as it says so."""
    try:
        support: Any = actor.get_dist(step).support
        return bool(support.is_discrete)
    except (AttributeError, NotImplementedError, TypeError):  # TorchRL's TanhNormal calls its own constraint
        return False


def _named(actor: Actor) -> str:
    """What draws an actor's actions."""
    last: Any = actor[-1] if hasattr(actor, "__getitem__") else actor
    return getattr(last, "distribution_class", type(last)).__name__


def ppo_agent(policy: Policy, config: PPOConfig | None = None) -> Agent:
    """A pretrained policy that goes on learning by PPO, with the critic that it was trained with.

    Its weights are the policy's: what is adapted is the policy that was given.
    """
    config = config or ONWARD
    critic = policy.network.critic
    return Agent(
        policy.actor, lambda actor, size: clipped(actor, critic, config), policy.sight, on_policy=config,
        weights=policy.network,
    )  # fmt: skip


class Action(nn.Module):
    """Q(observation, action), (..., 1)."""

    def __init__(self, scale: Scale, action: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.scale = scale
        self.body = perceptron((len(scale.mean) + action, *hidden, 1), 1.0)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """(..., 1)."""
        return self.body(torch.cat([self.scale(observation), action.clamp(-1, 1)], -1))


def sac_agent(policy: Policy, config: OffPolicyConfig | None = None) -> Agent:
    """The same by SAC: critics of actions are new, and learn alone at first."""
    sizes = policy.network.sizes

    def loss(actor: Actor, size: int) -> LossModule:
        values = Action(policy.network.scale, size, sizes.hidden).to(policy.network.scale.mean.device)
        critic = ValueOperator(values, in_keys=["observation", "action"])
        return SACLoss(actor, critic, target_entropy=-float(size), alpha_init=0.01)

    return Agent(policy.actor, loss, policy.sight, off_policy=config or OffPolicyConfig())
