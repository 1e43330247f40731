"""Planning by model-predictive path integrals in latent space, for many robots at once (paper, eq. 6 and below)."""

from typing import Protocol

import torch
from torch import Tensor

from nfc_gym.inference.data import Batch
from nfc_gym.inference.replay import tensor_cores

from .settings import Settings
from .speed import Speed
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
      speed: see `Speed`.

    Attributes:
      mean: (n, horizon, a) of the last plan.
    """

    def __init__(
        self, model: Model, settings: Settings, gamma: float, action: int, rows: int,
        device: torch.device | str = "cpu", speed: Speed | None = None,
    ) -> None:  # fmt: skip
        self.model, self.settings, self.gamma = model, settings, gamma
        self.mean = torch.zeros(rows, settings.horizon, action, device=device)
        self._none = torch.zeros(rows, dtype=torch.bool, device=device)
        self._action = torch.zeros(rows, action, device=device)
        speed = speed or Speed()
        self._first, self._next = self.prior, self.round
        if rows > 1:  # one robot's numbers are few: a graph alone does, and compiling takes longer than it saves
            self._first, self._next = speed.fused(self.prior), speed.fused(self.round)
        self._graphs = speed.replayed(device)

    def begin(self) -> None:
        """Episodes of all of them begin."""
        self.mean.zero_()

    @torch.no_grad()
    @tensor_cores()  # as the authors compute them
    def plan(self, observation: Tensor, fresh: Tensor | None = None, explore: bool = False) -> Tensor:
        """Actions (n, a).

        Args:
          observation: (n, o).
          fresh: (n,) which of them begin an episode, so that their last plans mean nothing; None is none.
          explore: add noise of the plan's own spread.
        """
        given = {"observation": observation, "fresh": self._none if fresh is None else fresh}
        self._graphs(self._explore if explore else self._settle, given)
        return self._action.clone()

    def _explore(self, given: Batch) -> None:
        action, spread = self._plan(given["observation"], given["fresh"])
        self._action.copy_((action + spread * torch.randn_like(action)).clamp(-1, 1))

    def _settle(self, given: Batch) -> None:
        self._action.copy_(self._plan(given["observation"], given["fresh"])[0].clamp(-1, 1))

    def _plan(self, observation: Tensor, fresh: Tensor) -> tuple[Tensor, Tensor]:
        """Actions (n, a) and the spread of their plans' first step (n, a); the plans' means stay in `mean`."""
        s = self.settings
        state = self.model.encode(observation)
        tried = self._first(state)
        mean = torch.cat([self.mean[:, 1:], torch.zeros_like(self.mean[:, :1])], 1) * ~fresh[:, None, None]
        std = torch.full_like(mean, s.max_std)
        for _ in range(s.iterations):
            mean, std, elites, weights = self._next(state, tried, mean, std)
        self.mean.copy_(mean)
        # One of the elites, each as likely as its weight: the first of exponential clocks; `multinomial` waits.
        chosen = (weights / torch.empty_like(weights).exponential_()).argmax(1)
        firsts = elites[:, :, 0]
        action = firsts.gather(1, chosen[:, None, None].expand(-1, 1, firsts.shape[2]))[:, 0]
        return action, std[:, 0]

    def round(self, state: Tensor, tried: Tensor, mean: Tensor, std: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """One round of planning.

        Args:
          state: (n, d).
          tried: (n, priors, horizon, a) sequences that come from the policy prior.
          mean, std: (n, horizon, a) of what the others are drawn from.

        Returns:
          Mean and spread of the elites (n, horizon, a), the elites (n, elites, horizon, a), their weights (n, elites).
        """
        s = self.settings
        noise = torch.randn(len(mean), s.samples - s.priors, *mean.shape[1:], device=mean.device)
        drawn = (mean[:, None] + std[:, None] * noise).clamp(-1, 1)
        actions = torch.cat([tried, drawn], 1)
        values, best = self.worth(state, actions).topk(s.elites, 1)
        elites = actions.gather(1, best[:, :, None, None].expand(-1, -1, *mean.shape[1:]))
        weights = (s.temperature * values).softmax(1)
        mean = torch.einsum("ne,neha->nha", weights, elites)
        spread = torch.einsum("ne,neha->nha", weights, (elites - mean[:, None]).square())
        return mean, spread.sqrt().clamp(s.min_std, s.max_std), elites, weights

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

    def prior(self, state: Tensor) -> Tensor:
        """(n, priors, horizon, a): sequences of the policy prior, from states (n, d)."""
        z = state[:, None].expand(-1, self.settings.priors, -1)
        actions = [self.model.act(z)]
        for _ in range(self.settings.horizon - 1):
            z = self.model.imagine(z, actions[-1]).state
            actions.append(self.model.act(z))
        return torch.stack(actions, 2)
