"""How a world model learns from sequences of steps: the losses of TD-MPC2 (paper, eqs. 3 and 4)."""

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

from nfc_gym.adaptation.ppo import Diverged
from nfc_gym.inference.replay import tensor_cores

from .world_model import WorldModel

PRIOR_EPS = 1e-5  # of Adam for the policy prior, as the authors have it


class Learner:
    """Updates a world model in place.

    Args:
      model: which.
      gamma: discount a control step.

    Attributes:
      optimiser: of the world model and, in a group of its own, of the policy prior.
      updates: that were made.
    """

    def __init__(self, model: WorldModel, gamma: float) -> None:
        self.model, self.gamma, self.updates = model, gamma, 0
        s = model.settings
        parts = [model.dynamics, model.rewards, model.critics, *([] if model.ends is None else [model.ends])]
        self.world = [*model.encoder.parameters(), *(p for part in parts for p in part.parameters())]
        self.prior = list(model.prior.parameters())
        self.optimiser = torch.optim.Adam(
            [
                {"params": self.world[: len(list(model.encoder.parameters()))], "lr": s.rate * s.encoder_rate},
                {"params": self.world[len(list(model.encoder.parameters())) :]},
                {"params": self.prior, "eps": PRIOR_EPS},
            ],
            lr=s.rate,
        )
        self.weights = torch.tensor([s.rho**t for t in range(s.horizon + 1)], device=model.device)

    @tensor_cores()  # as the authors compute them
    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """One step on sequences, see `replay`; returns values to write down.

        Raises:
          Diverged: a loss is not finite; the weights are those from before.
        """
        self.model.train()
        losses, states = self.losses(batch)
        s = self.model.settings
        total = (
            s.consistency * losses["consistency"] + s.reward * losses["reward"] + s.value * losses["value"]
            + s.termination * losses["termination"]
        )  # fmt: skip
        self._step(total, self.world)
        prior = self.prior_loss(states.detach())
        self._step(prior, self.prior)
        self.model.follow()
        self.model.eval()
        self.updates += 1
        return {"loss": total.detach(), "prior": prior.detach()} | {k: v.detach() for k, v in losses.items()}

    def losses(self, batch: TensorDictBase) -> tuple[dict[str, Tensor], Tensor]:
        """Each loss, its steps weighed by rho^t; and the latent states (b, horizon + 1, d) that were unrolled.

        Sequences begin from the encoded observation and go on by the model alone.
        """
        model, s = self.model, self.model.settings
        observed, action, reward, ended = (batch[k] for k in ("observation", "action", "reward", "ended"))
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

    def prior_loss(self, states: Tensor) -> Tensor:
        """Of the policy prior in latent states (b, horizon + 1, d): values by their scale, and entropy."""
        model = self.model
        action, entropy = model.propose(states)
        values = model.two_values(states, action).mean(0)
        model.rescale(values[:, 0].detach())
        gain = values / model.scale + model.settings.entropy * entropy
        return -(gain.mean(0) * self.weights).mean()

    def _step(self, loss: Tensor, parameters: list[nn.Parameter]) -> None:
        if not loss.isfinite():
            raise Diverged(f"the loss of update {self.updates} is not finite ({float(loss.detach()):g})")
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(parameters, self.model.settings.clip)
        self.optimiser.step()
