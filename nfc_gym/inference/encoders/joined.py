"""A window's encoders side by side: motion, physics summaries, map."""

import torch
from torch import Tensor, nn

from nfc_gym.core.errors import InputError
from nfc_gym.inference.encoders.base import Encoder, SignalEncoder
from nfc_gym.inference.encoders.kernels import FKS, RFF
from nfc_gym.inference.encoders.mlp import MLP
from nfc_gym.inference.encoders.resnet import ResNet18
from nfc_gym.inference.encoders.summaries import Regressions, Summaries
from nfc_gym.inference.encoders.tcn import TCN

ENCODERS = {"tcn": TCN, "nn": MLP, "qmc-rff": RFF, "qmc-fks": FKS}
BLIND = ("qmc-rff", "qmc-fks")  # kernel methods see no map (paper, "Baselines and Ablations")


class Joined(Encoder):
    """The features of one motion encoder, beside them those of the switches that are on.

    Args:
      name: of the motion encoder, or "none" for the summaries alone.
      horizon: H.
      states: s.
      actions: a.
      width: of the layers of `nn`.
      summaries: with physics summaries.
      regressions: theirs.
      elevation: with a map.

    Raises:
      InputError: no such encoder, no encoder at all, or a map for a kernel method.
    """

    def __init__(
        self, name: str, horizon: int, states: int, actions: int, *, width: int = 1024, summaries: bool = False,
        regressions: Regressions | None = None, elevation: bool = False,
    ) -> None:  # fmt: skip
        super().__init__()
        if name not in (*ENCODERS, "none"):
            raise InputError(f"no encoder named {name!r}; there are: {', '.join(ENCODERS)}, none")
        if elevation and name in BLIND:
            raise InputError(f"the encoder {name!r} sees no map; those that do: tcn, nn")
        parts: list[Encoder] = []
        if name == "nn":
            parts.append(MLP(horizon, states, actions, width))
        elif name != "none":
            parts.append(ENCODERS[name](horizon, states, actions))
        parts += [Summaries(horizon, states, actions, regressions)] if summaries else []
        parts += [ResNet18()] if elevation else []
        if name == "none" and not summaries:
            raise InputError("an encoder 'none' needs summaries beside it")
        self.summaries = next((p for p in parts if isinstance(p, Summaries)), None)
        self.signals = next((p.signals for p in parts if isinstance(p, SignalEncoder)), None)
        self.fixed_size = (
            self.summaries.features if self.summaries else self.signals.channels * (horizon + 1) if self.signals else 0
        )
        self.parts = nn.ModuleList(parts)
        self.elevation = elevation
        self.features = sum(p.features for p in parts)
        self.waits = any(p.waits for p in parts)

    def fit(self, states: Tensor, actions: Tensor, elevation: Tensor | None) -> None:
        """Each part's."""
        for part in self.parts:
            part.fit(states, actions, elevation)  # type: ignore[operator]

    def forward(self, states: Tensor, actions: Tensor, elevation: Tensor | None = None) -> Tensor:
        """(B, features).

        Raises:
          InputError: a map is needed and not given.
        """
        if self.elevation and elevation is None:
            raise InputError("this network was trained with an elevation map: give one with every window")
        return torch.cat([part(states, actions, elevation) for part in self.parts], 1)

    def fixed(self, states: Tensor, actions: Tensor) -> Tensor:
        """(B, fixed_size) what no training changes: the summaries where they are on, else the window's signals."""
        if self.summaries is not None:
            return self.summaries(states, actions)
        assert self.signals is not None  # the constructor refuses an encoder of neither
        return self.signals(states, actions).flatten(1)
