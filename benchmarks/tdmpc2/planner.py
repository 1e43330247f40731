"""Planning by model-predictive path integrals in latent space, for many robots at once (paper, eq. 6 and below)."""

from typing import Protocol

import torch
from torch import Tensor

from nfc_gym.inference.replay import tensor_cores

from .settings import Settings
from .world_model import Imagined


class Model(Protocol):
    """What a planner asks of a model; every method takes any leading shape."""

    def encode(self, observation: Tensor) -> Tensor:
        """Observations (..., o) -> states (..., d)."""
        ...

    def act(self, state: Tensor) -> Tensor:
        """Actions (..., a) worth trying."""
        ...

    def imagine(self, state: Tensor, action: Tensor) -> Imagined:
        """One step."""
        ...

    def value(self, state: Tensor) -> Tensor:
        """(...) of what comes after the horizon."""
        ...


class Planner:
    """Plans of n robots; each begins from what is left of its last one.

    Args:
      model: see `Model`.
      settings: of them the horizon, samples, elites, priors, iterations, temperature and limits are used.
      gamma: discount a control step.
      action: entries of an action.
      rows: n.
      device: of all tensors.

    Attributes:
      mean: (n, horizon, a) of the last plan.
    """

    def __init__(
        self, model: Model, settings: Settings, gamma: float, action: int, rows: int,
        device: torch.device | str = "cpu",
    ) -> None:  # fmt: skip
        self.model, self.settings, self.gamma = model, settings, gamma
        self.mean = torch.zeros(rows, settings.horizon, action, device=device)

    @torch.no_grad()
    @tensor_cores()  # as the authors compute them
    def plan(self, observation: Tensor, fresh: Tensor | None = None, explore: bool = False) -> Tensor:
        """Actions (n, a).

        Args:
          observation: (n, o).
          fresh: (n,) which of them begin an episode, so that their last plans mean nothing; None is none.
          explore: add noise of the plan's own spread.
        """
        s = self.settings
        state = self.model.encode(observation)
        tried = self._prior(state)
        mean = torch.cat([self.mean[:, 1:], torch.zeros_like(self.mean[:, :1])], 1)
        if fresh is not None:
            mean = mean * ~fresh[:, None, None]
        std = torch.full_like(mean, s.max_std)
        for _ in range(s.iterations):
            noise = torch.randn(len(mean), s.samples - s.priors, *mean.shape[1:], device=mean.device)
            drawn = (mean[:, None] + std[:, None] * noise).clamp(-1, 1)
            actions = torch.cat([tried, drawn], 1)
            values, best = self.worth(state, actions).topk(s.elites, 1)
            elites = actions.gather(1, best[:, :, None, None].expand(-1, -1, *mean.shape[1:]))
            weights = (s.temperature * values).softmax(1)
            mean = torch.einsum("ne,neha->nha", weights, elites)
            spread = torch.einsum("ne,neha->nha", weights, (elites - mean[:, None]).square())
            std = spread.sqrt().clamp(s.min_std, s.max_std)
        self.mean = mean
        chosen = torch.multinomial(weights, 1)[:, 0]
        action = elites[torch.arange(len(elites), device=mean.device), chosen, 0]
        if explore:
            action = action + std[:, 0] * torch.randn_like(action)
        return action.clamp(-1, 1)

    def worth(self, state: Tensor, actions: Tensor) -> Tensor:
        """(n, m) discounted reward of action sequences (n, m, horizon, a) from states (n, d), and value of their ends.

        After a step that ends the episode nothing is earned.
        """
        z = state[:, None].expand(-1, actions.shape[1], -1)
        total, factor = torch.zeros(actions.shape[:2], device=actions.device), 1.0
        going = torch.ones_like(total)
        for action in actions.unbind(2):
            z, reward, ended = self.model.imagine(z, action)
            total = total + factor * going * reward
            factor, going = factor * self.gamma, going * ~ended
        return (total + factor * going * self.model.value(z)).nan_to_num(0.0)

    def _prior(self, state: Tensor) -> Tensor:
        """(n, priors, horizon, a): sequences of the policy prior."""
        z = state[:, None].expand(-1, self.settings.priors, -1)
        actions = []
        for _ in range(self.settings.horizon):
            actions.append(self.model.act(z))
            z = self.model.imagine(z, actions[-1]).state
        return torch.stack(actions, 2)
