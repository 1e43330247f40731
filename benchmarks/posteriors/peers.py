"""sbi's NPE (neural spline flow) and NPSE on the same windows, with the same encoder, in the same coordinates.

sbi sees z = probit(u), in which the prior is N(0, I) and nothing leaks over the box's edges, and x, the window of
states and actions in one row; our encoder, trained with sbi's network, is its embedding. What it does otherwise, its
defaults of network, optimiser, batch order and early stopping, is sbi's. It has no noise drawn anew with each pass:
its x is one draw of noise a window.
"""

import math
import time
from typing import Any

import torch
from torch import Tensor, nn

from nfc_gym.core.errors import MissingExtra
from nfc_gym.inference.config import Sizes
from nfc_gym.inference.data import Batch
from nfc_gym.inference.encoders.place import place_of
from nfc_gym.inference.network import Network
from nfc_gym.inference.random import seeded
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import Outcome
from posteriors.fitted import gain_of, truth_of
from posteriors.methods import Method, network_config
from posteriors.sets import Held

PATIENCE = 20  # epochs, ours too


class Embedding(nn.Module):
    """A row of states, actions (and map) through our encoder, on scales of the training set."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.place, self.encoder, self.project, self.sizes = (
            network.place,
            network.encoder,
            network.project,
            network.sizes,
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, F)."""
        size = self.sizes
        states, actions = (size.horizon + 1) * size.states, size.horizon * size.actions
        rows = x.split([states, actions, x.shape[1] - states - actions], 1)
        elevation = rows[2].view(-1, 128, 128) if rows[2].shape[1] else None
        motion = (
            self.place(rows[0].view(-1, size.horizon + 1, size.states)),
            rows[1].view(-1, size.horizon, size.actions),
        )
        return self.project(self.encoder(*motion, elevation))


def row_of(batch: Batch, names: tuple[str, ...]) -> Tensor:
    """(B, everything) that a peer sees of windows."""
    return torch.cat([batch[k].flatten(1) for k in names], 1)


class Peer:
    """A posterior of sbi, see `Fitted`."""

    def __init__(self, kind: str, estimator: Any, posterior: Any, free: Tensor, maps: bool) -> None:
        self.kind, self.estimator, self.posterior, self.free = kind, estimator, posterior, free
        self.names = ("states", "actions", *(["map"] if maps else []))

    def draws(self, batch: Batch, n: int, seed: int) -> Tensor:
        """See `Fitted`."""
        x, out = row_of(batch, self.names), []
        with seeded(seed), torch.no_grad():
            for part in x.split(32):
                if self.kind == "npe":
                    z = self.estimator.sample((n,), condition=part).transpose(0, 1)
                else:
                    z = self.posterior.sample_batched((n,), x=part, show_progress_bars=False).transpose(0, 1)
                out.append(torch.special.ndtr(z.double()))
        return torch.cat(out)

    def gain(self, batch: Batch) -> Tensor:
        """See `Fitted`; NPSE solves an ODE for each window."""
        x, z = row_of(batch, self.names), truth_of(batch["psi"][:, self.free.to(batch["psi"].device)])
        out = []
        for some, at in zip(x.split(64), z.split(64), strict=True):
            if self.kind == "npe":
                with torch.no_grad():
                    value = self.estimator.log_prob(at[None], condition=some)[0]
            else:
                each = (self.posterior.log_prob(a[None], x=s[None]).detach() for a, s in zip(at, some, strict=True))
                value = torch.cat(list(each))
            out.append(gain_of(at, value).double())
        return torch.cat(out)


def fit_peer(
    method: Method, inputs: str, windows: Held, prior: PriorBox, plan: Any, seed: int, device: torch.device
) -> tuple[Peer, Outcome, int]:  # fmt: skip
    """Train NPE or NPSE until it stops by itself, its epochs or its seconds are used up.

    Raises:
      MissingExtra: sbi is not installed.
    """
    try:
        from sbi.inference import NPE, NPSE
        from sbi.neural_nets import posterior_nn, posterior_score_nn
    except ImportError as e:
        raise MissingExtra(f"sbi is not installed ({e}): pip install 'nfc_gym[bench]'") from None
    batch = windows.noisy(seed + 1)
    free = torch.tensor(prior.free)
    sizes = Sizes.of(batch, place=place_of(windows.names))
    network = Network(network_config(method, inputs, plan.small), sizes, prior, seed)
    network.fit_scales({k: t[:16384].cpu() for k, t in batch.items()})
    embedding = Embedding(network).to(device)
    d = prior.size
    normal = torch.distributions.MultivariateNormal(torch.zeros(d, device=device), torch.eye(d, device=device))
    common: dict[str, Any] = {"embedding_net": embedding, "z_score_x": "none", "z_score_theta": "none"}
    how = {"device": str(device), "show_progress_bars": False}
    if method.density == "npe":
        trainer = _limited(NPE)(normal, density_estimator=posterior_nn("nsf", **common), **how)
    else:
        trainer = _limited(NPSE)(normal, vf_estimator=posterior_score_nn(sde_type="vp", **common), **how)
    maps = inputs == "map"
    x = row_of(batch, ("states", "actions", *(["map"] if maps else [])))
    trainer.ends = time.monotonic() + plan.budget if plan.budget else math.inf
    began = time.monotonic()
    with seeded(seed):
        trainer.append_simulations(truth_of(batch["psi"][:, free.to(device)]), x, data_device=str(device))
        estimator = trainer.train(training_batch_size=plan.batch, learning_rate=plan.rate, stop_after_epochs=PATIENCE,
                                  max_num_epochs=plan.epochs)  # fmt: skip
    losses = [float(v) for v in trainer.summary["validation_loss"]]
    best = min(range(len(losses)), key=losses.__getitem__) + 1
    seconds = time.monotonic() - began
    outcome = Outcome([float(v) for v in trainer.summary["training_loss"]], losses, best=best, seconds=seconds)
    outcome.stopped = "budget" if time.monotonic() >= trainer.ends else "its own end"
    return Peer(method.density, estimator.eval(), trainer.build_posterior(estimator), free, maps), outcome, plan.epochs


def _limited(kind: type) -> type:
    """The same trainer, which also ends when its time is used up; sbi asks once an epoch."""

    class Limited(kind):
        ends = math.inf

        def _converged(self, *args: Any, **more: Any) -> bool:
            return super()._converged(*args, **more) or time.monotonic() >= self.ends

    return Limited
