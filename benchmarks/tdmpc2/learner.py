"""How a world model learns from sequences of steps: the losses of TD-MPC2 (paper, eqs. 3 and 4)."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from nfc_gym.adaptation.ppo import Diverged
from nfc_gym.inference.data import Batch
from nfc_gym.inference.replay import tensor_cores

from .speed import Speed
from .world_model import WorldModel

PRIOR_EPS = 1e-5  # of Adam for the policy prior, as the authors have it
LOSSES = ("consistency", "reward", "value", "termination")
PARTS = ("observation", "action", "reward", "ended")  # of sequences


class Learner:
    """Updates a world model in place.

    Nothing in an update waits for the device, so that a GPU can replay it whole. From the first loss on that is not
    finite nothing changes any more; `check` tells of it.

    Args:
      model: which.
      gamma: discount a control step.
      speed: see `Speed`.

    Attributes:
      optimiser: of the world model and, in a group of its own, of the policy prior.
      updates: that were made.
      lost: () 1 from the first loss on that is not finite, on the device.
    """

    def __init__(self, model: WorldModel, gamma: float, speed: Speed | None = None) -> None:
        self.model, self.gamma, self.updates = model, gamma, 0
        self.speed = speed or Speed()
        s, device = model.settings, model.device
        parts = [model.dynamics, model.rewards, model.critics, *([] if model.ends is None else [model.ends])]
        encoder = list(model.encoder.parameters())
        self.world = [*encoder, *(p for part in parts for p in part.parameters())]
        self.prior = list(model.prior.parameters())
        self.optimiser = torch.optim.Adam(
            [
                {"params": self.world[: len(encoder)], "lr": s.rate * s.encoder_rate},
                {"params": self.world[len(encoder) :]},
                {"params": self.prior, "eps": PRIOR_EPS},
            ],
            lr=s.rate, fused=True, capturable=device.type == "cuda",
        )  # fmt: skip
        self.lost = torch.zeros((), device=device)
        self.optimiser.found_inf = self.lost  # as a GradScaler says that a step is to change nothing
        self.weights = torch.tensor([s.rho**t for t in range(s.horizon + 1)], device=device)
        self._values = torch.zeros(2 + len(LOSSES), device=device)
        self._made, self._odd = torch.zeros((), device=device), torch.zeros((), device=device)
        self._losses = self.speed.fused(self.losses, learns=True)
        self._tried = self.speed.fused(self.tried, learns=True)
        self._graphs = self.speed.replayed(device)

    @tensor_cores()  # as the authors compute them
    def update(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """One step on sequences, see `replay`; returns values to write down.

        Raises:
          Diverged: a loss is not finite; the weights are those from before. On a GPU `check` raises it.
        """
        self._graphs(self._work, {name: batch[name] for name in PARTS})
        self.updates += 1
        if self.lost.device.type == "cpu":
            self.check()
        return dict(zip(("loss", "prior", *LOSSES), self._values.clone().unbind(), strict=True))

    def check(self) -> None:
        """Wait for what was begun.

        Raises:
          Diverged: a loss was not finite.
        """
        lost, made, odd = torch.stack([self.lost, self._made, self._odd]).tolist()
        if lost:
            self.updates = round(made)
            raise Diverged(f"the loss of update {self.updates} is not finite ({odd:g})")

    def go_on(self, updates: int) -> None:
        """After the optimiser's state was replaced: so many updates were made, and what was captured holds no more."""
        self.updates = updates
        self._made.fill_(updates)
        self._graphs = self.speed.replayed(self.lost.device)

    def losses(
        self, observed: Tensor, action: Tensor, reward: Tensor, ended: Tensor
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Each loss, its steps weighed by rho^t; and the latent states (b, horizon + 1, d) that were unrolled.

        Sequences begin from the encoded observation and go on by the model alone.
        """
        model, s = self.model, self.model.settings
        with torch.no_grad():
            after = model.encode(observed[:, 1:])
            worth = model.two_values(after, model.act(after), target=True).amin(0)
            wanted = reward + self.gamma * ~ended * worth
        states = [model.encode(observed[:, 0])]
        for a in action.unbind(1):
            states.append(model.next(states[-1], a))
        latent = torch.stack(states, 1)
        before, rho = latent[:, :-1], self.weights[:-1] / s.horizon
        values = model.two_hot.loss(model.value_logits(before, action), wanted)
        losses = {
            "consistency": (F.mse_loss(latent[:, 1:], after, reduction="none").mean((0, 2)) * rho).sum(),
            "reward": (model.two_hot.loss(model.reward_logits(before, action), reward).mean(0) * rho).sum(),
            "value": (values.mean((0, 1)) * rho).sum(),
            "termination": latent.new_zeros(()),
        }
        odds = model.end_logits(latent[:, 1:])
        if odds is not None:
            losses["termination"] = F.binary_cross_entropy_with_logits(odds, ended.to(odds.dtype))
        return losses, latent

    def tried(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Values and entropies (b, horizon + 1) of what the policy prior draws in latent states (b, horizon + 1, d)."""
        action, entropy = self.model.propose(states)
        return self.model.two_values(states, action).mean(0), entropy

    def prior_loss(self, states: Tensor) -> Tensor:
        """Of the policy prior in latent states (b, horizon + 1, d): values by their scale, and entropy."""
        model = self.model
        values, entropy = self._tried(states)
        model.rescale(values[:, 0].detach(), self.lost)
        gain = values / model.scale + model.settings.entropy * entropy
        return -(gain.mean(0) * self.weights).mean()

    def _work(self, batch: Batch) -> None:
        """An update, in place."""
        model, s = self.model, self.model.settings
        model.train()
        losses, states = self._losses(*(batch[name] for name in PARTS))
        total = (
            s.consistency * losses["consistency"] + s.reward * losses["reward"] + s.value * losses["value"]
            + s.termination * losses["termination"]
        )  # fmt: skip
        self._step(total, self.world)
        prior = self.prior_loss(states.detach())
        self._step(prior, self.prior)
        model.follow(self.lost)
        model.eval()
        self._made.add_(1 - self.lost)
        told = [total, prior, *(losses[name] for name in LOSSES)]
        self._values.copy_(torch.stack([t.detach() for t in told]))

    def _step(self, loss: Tensor, parameters: list[nn.Parameter]) -> None:
        value = loss.detach()
        fine = value.isfinite()
        self._odd.copy_(torch.where((self.lost == 0) & ~fine, value, self._odd))
        self.lost.copy_(torch.where(fine, self.lost, 1.0))
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(parameters, self.model.settings.clip)
        self.optimiser.step()
