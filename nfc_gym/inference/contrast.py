"""The contrastive detector: does a window go on as it began?

A causal TCN maps the first half of a window (the context) and its second half (the target) onto one hypersphere. With

    p = exp((cos - 1) / lambda)

standing for the probability that the two belong together, windows as simulated are drawn together and those with an
injected disturbance in the target apart: -log p and -log(1 - p) (paper, section "Anomaly Detection"; there the
exponent is cos / lambda - 1, which reaches 1 for lambda = 1 alone). The score is 1 - cos.

It sees neither psi nor the simulator: a fault that was there before the window began, and moves the robot as another
psi or another action might, is not its to find. `nfc_gym.simulate.replay` is for those.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from nfc_gym.core.errors import InputError
from nfc_gym.core.whole import require_whole
from nfc_gym.inference.config import Sizes
from nfc_gym.inference.data import Batch
from nfc_gym.inference.detector import checked
from nfc_gym.inference.encoders.base import TINY
from nfc_gym.inference.encoders.tcn import TCN
from nfc_gym.inference.injections import KINDS, injected
from nfc_gym.inference.learner import Learner
from nfc_gym.inference.random import seeded
from nfc_gym.inference.space import PriorBox

Array = NDArray[np.float64]
_NEAR = 1e-4  # 1 - cos is kept from 0 in log(1 - p), where equal halves would cost infinitely much
_ROWS = 1024  # windows scored at once


@dataclass(frozen=True)
class ContrastConfig:
    """What is built.

    Attributes:
      features: dimensions of the hypersphere.
      temperature: lambda.
      share: of the windows of a batch that are given a disturbance.
    """

    features: int = 64
    temperature: float = 0.5
    share: float = 0.5
    elevation: ClassVar[bool] = False

    def __post_init__(self) -> None:
        require_whole("contrast: features", self.features, 2)
        if not self.temperature > 0 or not 0 < self.share < 1:
            raise InputError(
                "contrast: want a temperature > 0 and a share between 0 and 1, "
                f"got {self.temperature:g}, {self.share:g}"
            )

    def to_dict(self) -> dict[str, Any]:
        """Plain values that JSON holds."""
        return asdict(self)


class Contrast(Learner):
    """Context and target on one hypersphere; a `WindowScore`.

    Args:
      config: what to build.
      sizes: of a window; H is 8 or more.
      prior: whose windows these are.
      channels: names of the states' entries, kept in its file.
      seed: of the initial weights.
    """

    spread: Tensor

    def __init__(
        self, config: ContrastConfig, sizes: Sizes, prior: PriorBox, channels: tuple[str, ...] = (), seed: int = 0
    ) -> None:
        super().__init__()
        if sizes.horizon < 8:
            raise InputError(f"contrast: two halves of 4 steps or more make a window of 8, got {sizes.horizon}")
        self.config, self.sizes, self.prior, self.channels = config, sizes, prior, tuple(channels)
        self.horizon, self.states, self.actions = sizes.horizon, sizes.states, sizes.actions
        self.span = sizes.horizon // 2
        with seeded(seed):
            self.encoder = TCN(self.span, sizes.states, sizes.actions)
            self.project = nn.Linear(self.encoder.features, config.features)
        self.register_buffer("spread", torch.ones(sizes.states))

    @torch.no_grad()
    def fit_scales(self, batch: Batch) -> None:
        """Scales of the encoder, and the channels' spreads that disturbances are measured in.

        Raises:
          InputError: the windows are of other sizes.
        """
        checked(self, batch["states"].cpu(), batch["actions"].cpu())
        states, actions = batch["states"], batch["actions"]
        self.encoder.fit(states[:, : self.span + 1], actions[:, : self.span], None)
        flat = states.reshape(-1, self.states).double()
        spread = flat.std(0, correction=0)
        self.spread.copy_(torch.where(spread > TINY * (1 + flat.mean(0).abs()), spread, 0.0))

    def closeness(self, states: Tensor, actions: Tensor) -> Tensor:
        """(B,) cosine between the halves of windows (B, H+1, s), (B, H, a)."""
        h = self.span
        # Both halves in one pass: of a single window the calls cost more than the numbers.
        halves = (torch.cat([states[:, : h + 1], states[:, -h - 1 :]]), torch.cat([actions[:, :h], actions[:, -h:]]))
        context, target = self.project(self.encoder(*halves)).chunk(2)
        return nn.functional.cosine_similarity(context, target, dim=1)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Cross-entropy of p over a batch, part of which is given disturbances here."""
        states, h = batch["states"], self.span
        b = len(states)
        kind = torch.randint(len(KINDS), (b,), device=states.device)
        struck = torch.rand(b, device=states.device) < self.config.share
        # The last step of the context is the first of the target; the disturbance begins after it.
        target = torch.where(struck[:, None, None], injected(states[:, -h:], self.spread, kind), states[:, -h:])
        cos = self.closeness(torch.cat([states[:, :-h], target], 1), batch["actions"]).float()
        log_p = (cos - 1) / self.config.temperature
        apart = -torch.log(-torch.expm1(log_p.clamp(max=-_NEAR)))
        return {"contrast": torch.where(struck, apart, -log_p).mean()}

    @torch.no_grad()
    def score(self, states: Array, actions: Array) -> Array:
        """(n,) 1 - cos, between 0 and 2, of windows (n, H+1, s), (n, H, a), or longer ones from their end.

        Raises:
          InputError: windows shorter than H, of other widths, or not finite.
        """
        states, actions = checked(self, states, actions)
        if self.training:  # modules are walked through one by one
            self.eval()
        parts = []
        for at in range(0, len(states), _ROWS):
            pair = (torch.as_tensor(x[at : at + _ROWS], dtype=torch.float32, device=self.spread.device)
                    for x in (states, actions))  # fmt: skip
            parts.append(1 - self.closeness(*pair).double().cpu().numpy())
        return np.concatenate(parts) if parts else np.zeros(0)

    @classmethod
    def of(
        cls, batch: Mapping[str, Tensor], prior: PriorBox, config: ContrastConfig | None = None, **more: Any
    ) -> "Contrast":
        """One for windows like these; `more` as of the constructor."""
        return cls(config or ContrastConfig(), Sizes.of(dict(batch)), prior, **more)
