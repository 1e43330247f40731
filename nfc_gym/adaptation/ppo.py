"""PPO on TorchRL's clipped loss, advantages and replay buffer; the step size of the actor follows the divergence."""

import math
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.objectives import ClipPPOLoss, LossModule, ValueEstimators

from nfc_gym.core.errors import NfcError

Actor = ProbabilisticTensorDictSequential
_TOLD = ("loss_critic", "kl_approx", "clip_fraction")
_SLOWEST, _FASTEST = 1e-5, 2e-3  # step sizes
_RUNAWAY = 5.0  # nats between two policies of one iteration: nothing that was learned so far is left
_BAND = 1.5  # either way, within which the divergence is as wanted; by which the step size changes beyond
_FAR = 2.0  # times the divergence that is wanted, after which an iteration goes no further
_SHORTEST, _LONGEST = 16, 128  # control steps of a simulation in an iteration
_FORGET = 0.98  # an iteration's share of the past in the size of rewards


class Diverged(NfcError):
    """Training came apart; the message says how, and the weights are those from before."""


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """Settings of PPO.

    Attributes:
      gamma, trace: discount a control step, and lambda of the generalised advantage.
      clip: of the ratio of densities.
      epochs, minibatches: passes over an iteration's steps, and parts of each.
      rate: first step size of the actor.
      critic_rate: step size of the critic, which stays: what is led by how far the policy moves may be far too small
        to learn values with.
      divergence: nats that the policy should move an iteration; the actor's step size is led there.
      entropy: weight of the bonus.
      norm: gradients are cut to this.
      together: control steps of all simulations in an iteration.
    """

    gamma: float = 0.99
    trace: float = 0.95
    clip: float = 0.2
    epochs: int = 5
    minibatches: int = 4
    rate: float = 3e-4
    critic_rate: float = 1e-3
    divergence: float = 0.02
    entropy: float = 0.002
    norm: float = 1.0
    together: int = 4096


# Of what begins with weights that were trained before: small first steps, until the critic knows what is new, and
# little reward for exploring, since the way is known. (With a gamma of 0.995, in iterations of 4096 steps, Quadcopter
# Rough unlearned its goals; with this it does so later.)
ONWARD = PPOConfig(entropy=0.001, rate=1e-4)


def summed(losses: TensorDictBase) -> Tensor:
    """What a TorchRL loss wants minimised: the sum of its terms."""
    return torch.stack([v.mean() for k, v in losses.items() if str(k).startswith("loss_")]).sum()


def require_finite(norm: Tensor) -> None:
    """Raises `Diverged` where the norm () of a gradient is not finite, as of a finite loss it may be."""
    if not norm.isfinite():
        raise Diverged(f"the gradient is not finite (its norm is {float(norm):g})")


class Power(nn.Module):
    """Running mean square of rewards."""

    value: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("value", torch.zeros(()))

    @torch.no_grad()
    def forward(self, reward: Tensor) -> Tensor:
        """Rewards over their root mean square, these included."""
        square = reward.square().mean()
        self.value.copy_(square if self.value == 0 else _FORGET * self.value + (1 - _FORGET) * square)
        return reward / (self.value.sqrt() + 1e-8)


def clipped(actor: Actor, critic: TensorDictModule, config: PPOConfig) -> ClipPPOLoss:
    """PPO's loss of an actor and a critic.

    It is not functional: the modules stay one with those that collect and those that are saved.
    """
    return ClipPPOLoss(
        actor, critic, clip_epsilon=config.clip, entropy_coeff=config.entropy, critic_coeff=1.0,
        loss_critic_type="l2", normalize_advantage=True, clip_value=config.clip, functional=False,
    )  # fmt: skip


class OnPolicy:
    """Improves an actor and a critic from batches of steps that the actor took, by any loss that wants advantages.

    Rewards are divided by their running root mean square and by the horizon 1 / (1 - gamma), so that values are of
    order one whatever a robot's reward is measured in.

    Args:
      loss: a TorchRL loss with a critic of state values, `clipped` or another of its on-policy ones.
      config: see `PPOConfig`; `clip` and `entropy` are of the loss, and the step size of one that does not tell its
        divergence stays.
    """

    def __init__(self, loss: LossModule, config: PPOConfig) -> None:
        self.config, self.loss = config, loss
        loss.make_value_estimator(ValueEstimators.GAE, gamma=config.gamma, lmbda=config.trace)
        critic = [p for name, p in loss.named_parameters() if name.startswith("critic_network")]
        others = [p for name, p in loss.named_parameters() if not name.startswith("critic_network")]
        groups = [{"params": others}, {"params": critic, "lr": config.critic_rate}]
        self.optimiser = torch.optim.Adam(groups, lr=config.rate, eps=1e-5)
        self.power = Power().to(next(loss.parameters()).device)

    def horizon(self, n: int) -> int:
        """Control steps that it wants of each of n simulations in a batch."""
        return min(max(self.config.together // n, _SHORTEST), _LONGEST)

    @property
    def rate(self) -> float:
        """The actor's present step size."""
        return self.optimiser.param_groups[0]["lr"]

    @rate.setter
    def rate(self, value: float) -> None:
        self.optimiser.param_groups[0]["lr"] = min(max(value, _SLOWEST), _FASTEST)

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """One iteration.

        Args:
          batch: (n, T) steps in the order in which they were taken.

        Returns:
          Means over the updates: losses, `divergence` in nats, `clipped` share, step size; NaN is what the loss does
          not tell.

        Raises:
          Diverged: a loss or its gradient is not finite, or the policy ran away.
        """
        steps = self._prepared(batch)
        buffer = self._filled(steps)
        rows: list[tuple[float, float, float, float]] = []
        moved = math.nan
        for _ in range(self.config.epochs):
            rows += [self._update(buffer.sample()) for _ in range(self.config.minibatches)]
            moved = fmean(row[2] for row in rows[-self.config.minibatches :])
            if moved > _FAR * self.config.divergence:
                break
        self._lead(moved)
        mean = torch.tensor(rows).mean(0).tolist()
        return dict(zip(("loss", "critic_loss", "divergence", "clipped"), mean, strict=True)) | {"rate": self.rate}

    def _lead(self, moved: float) -> None:
        """The actor's next step size, from the nats that an iteration's last pass saw the policy moved by.

        It changes between iterations alone: the divergence begins anew with each, so that a size that followed it from
        update to update would soar in the first few and be next to nothing in all others.
        """
        if moved > _BAND * self.config.divergence:
            self.rate /= _BAND
        elif moved < self.config.divergence / _BAND:
            self.rate *= _BAND

    def _filled(self, steps: TensorDictBase) -> ReplayBuffer:
        """A buffer of these steps; a new one each time, whose order follows from the present seed alone."""
        buffer = ReplayBuffer(
            storage=LazyTensorStorage(len(steps), device=steps.device or "cpu"), sampler=SamplerWithoutReplacement(),
            batch_size=max(1, len(steps) // self.config.minibatches),
        )  # fmt: skip
        buffer.extend(steps)
        return buffer

    @torch.no_grad()
    def _prepared(self, batch: TensorDictBase) -> TensorDictBase:
        """(n T,) steps with advantages."""
        scaled = batch.copy()
        scaled["next", "reward"] = (1 - self.config.gamma) * self.power(batch["next", "reward"])
        loss: Any = self.loss
        params = loss.critic_network_params  # None where the loss is not functional
        loss.value_estimator(
            scaled,
            params=None if params is None else params.detach(),
            target_params=loss.target_critic_network_params,
        )
        return scaled.exclude("next", "done", "terminated", "truncated", "success", "collector").reshape(-1)

    def _update(self, steps: TensorDictBase) -> tuple[float, float, float, float]:
        losses = self.loss(steps)
        total = summed(losses)
        untold = torch.full((), math.nan)  # some losses do not say how far they moved the policy
        told = [losses.get(key, untold).mean().to(total.device) for key in _TOLD]
        loss, critic, divergence, clipped = torch.stack([total, *told]).detach().tolist()
        if not math.isfinite(loss):
            raise Diverged(f"the loss is not finite ({loss:g}; of the critic {critic:g}, {divergence:g} nats moved)")
        if divergence > _RUNAWAY:
            raise Diverged(f"the policy moved by {divergence:.3g} nats within an iteration, more than {_RUNAWAY:g}")
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()
        for group in self.optimiser.param_groups:
            require_finite(nn.utils.clip_grad_norm_(group["params"], self.config.norm))
        self.optimiser.step()
        return loss, critic, divergence, clipped
