"""The world model of TD-MPC2: what follows, what it earns, what is worth what, and what to try first."""

import copy
from dataclasses import dataclass
from math import log, pi
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .networks import Critics, SimNorm, TwoHot, perceptron
from .settings import Settings

LOG_STD = (-10.0, 2.0)  # of the policy prior, as published
SCALE_BETWEEN = (0.05, 0.95)  # quantiles whose distance is the scale of values


@dataclass(frozen=True)
class Sizes:
    """Of an observation and of an action."""

    observation: int
    action: int


class Proposed(NamedTuple):
    """What the policy prior draws: actions (..., a) in [-1, 1] and their entropies' one-sample estimate (...)."""

    action: Tensor
    entropy: Tensor


class Imagined(NamedTuple):
    """A step in latent space: the state after it (..., d), its reward (...), whether it ends the episode (...) bool."""

    state: Tensor
    reward: Tensor
    ended: Tensor


class WorldModel(nn.Module):
    """Encoder h, dynamics d, reward R, value Q, policy prior p, and termination, all on latent states (paper, eq. 1).

    Args:
      sizes: see `Sizes`.
      settings: see `Settings`.

    Attributes:
      scale: running distance between the 5th and the 95th percentile of values, at least 1.
    """

    scale: Tensor

    def __init__(self, sizes: Sizes, settings: Settings) -> None:
        super().__init__()
        self.sizes, self.settings = sizes, settings
        s, both = settings, settings.latent + sizes.action
        hidden = (s.hidden, s.hidden)
        self.encoder = perceptron(sizes.observation, (s.encoder,), s.latent, SimNorm(s.simplex))
        self.dynamics = perceptron(both, hidden, s.latent, SimNorm(s.simplex))
        self.rewards = perceptron(both, hidden, s.bins)
        nn.init.zeros_(self.rewards[-1].weight)
        self.ends = perceptron(s.latent, hidden, 1) if s.episodic else None
        self.prior = perceptron(s.latent, hidden, 2 * sizes.action)
        self.critics = Critics(s.critics, both, hidden, s.bins, s.dropout)
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        self.two_hot = TwoHot(s.bins, s.bound)
        self.register_buffer("scale", torch.ones(()))

    @property
    def device(self) -> torch.device:
        """Of the weights."""
        return self.scale.device

    def train(self, mode: bool = True) -> "WorldModel":
        """The targets never drop anything out."""
        super().train(mode)
        self.targets.eval()
        return self

    def encode(self, observation: Tensor) -> Tensor:
        """(..., o) -> (..., d)."""
        return self.encoder(observation)

    def next(self, state: Tensor, action: Tensor) -> Tensor:
        """Latent state (..., d) after an action (..., a)."""
        return self.dynamics(torch.cat([state, action], -1))

    def reward_logits(self, state: Tensor, action: Tensor) -> Tensor:
        """(..., bins)."""
        return self.rewards(torch.cat([state, action], -1))

    def end_logits(self, state: Tensor) -> Tensor | None:
        """Log-odds (...) that an episode ended by reaching a state; None where none does."""
        return None if self.ends is None else self.ends(state)[..., 0]

    def value_logits(self, state: Tensor, action: Tensor) -> Tensor:
        """(k, ..., bins), of all critics."""
        return self.critics(torch.cat([state, action], -1))

    def two_values(self, state: Tensor, action: Tensor, *, target: bool = False, frozen: bool = True) -> Tensor:
        """(2, ...) of two critics drawn at random; no gradient reaches frozen ones."""
        net = self.targets if target else self.critics
        chosen = torch.rand(net.count, device=state.device).topk(2).indices  # any two as likely; `randperm` waits
        return self.two_hot.decode(net(torch.cat([state, action], -1), chosen, frozen))

    def propose(self, state: Tensor) -> Proposed:
        """A draw of the policy prior, a Gaussian squashed by tanh."""
        mean, log_std = self.prior(state).chunk(2, -1)
        low, high = LOG_STD
        log_std = low + (high - low) * (log_std.tanh() + 1) / 2
        noise = torch.randn_like(mean)
        raw = mean + noise * log_std.exp()
        # log(1 - tanh^2), in a form that is exact where tanh has become one
        squash = 2 * (log(2) - raw - F.softplus(-2 * raw))
        log_density = -noise.square() / 2 - log_std - log(2 * pi) / 2 - squash
        return Proposed(raw.tanh(), -log_density.sum(-1))

    # ---- what a planner asks --------------------------------------------------------------------------------------

    def act(self, state: Tensor) -> Tensor:
        """Actions (..., a) of the policy prior."""
        return self.propose(state).action

    def imagine(self, state: Tensor, action: Tensor) -> Imagined:
        """One step."""
        after = self.next(state, action)
        reward = self.two_hot.decode(self.reward_logits(state, action))
        odds = self.end_logits(after)
        return Imagined(after, reward, torch.zeros_like(reward, dtype=torch.bool) if odds is None else odds > 0)

    def value(self, state: Tensor) -> Tensor:
        """(...) of going on by the policy prior: the mean of two critics."""
        return self.two_values(state, self.act(state)).mean(0)

    # ---- what follows slowly --------------------------------------------------------------------------------------

    @torch.no_grad()
    def follow(self, lost: Tensor | None = None) -> None:
        """Target critics move a little towards the critics; not where `lost` () is 1."""
        targets = list(self.targets.parameters())
        away = torch._foreach_sub(list(self.critics.parameters()), targets)  # type: ignore[attr-defined]
        share = torch.full_like(self.scale, self.settings.follow)
        torch._foreach_mul_(away, share if lost is None else share * (1 - lost))  # type: ignore[attr-defined]
        torch._foreach_add_(targets, away)  # type: ignore[attr-defined]

    @torch.no_grad()
    def rescale(self, values: Tensor, lost: Tensor | None = None) -> None:
        """The scale moves a little towards that of a batch of values; not where `lost` () is 1."""
        ordered = values.flatten().sort().values
        low, high = (quantile(ordered, q) for q in SCALE_BETWEEN)
        moved = self.scale.lerp((high - low).clamp(min=1), self.settings.follow)
        self.scale.copy_(moved if lost is None else torch.where(lost == 0, moved, self.scale))


def quantile(ordered: Tensor, share: float) -> Tensor:
    """() of values (n,) in ascending order, between two of them linearly; `Tensor.quantile` may ask the processor."""
    place = share * (len(ordered) - 1)
    low = int(place)
    return ordered[low].lerp(ordered[min(low + 1, len(ordered) - 1)], place - low)
