"""The fault classifier: which kind of fault does a window show, by a network that was shown windows with faults?

Where a replay asks whether what is believed explains a window, by simulating it, this network was trained on simulated
windows with and without faults beforehand (`simulate.faulty.lessons`), and answers in the time of one pass. Its score
is the logarithm of the odds of any fault. Trained to the end it is the likelihood ratio of faulty machines, as they
were drawn, to those that are believed: no test finds more of them at the same rate of false alarms (Neyman and
Pearson). Of faults unlike those it was shown it promises nothing.
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
from nfc_gym.inference.encoders import Joined, Regressions
from nfc_gym.inference.encoders.place import Place
from nfc_gym.inference.heads.structure import Structure
from nfc_gym.inference.learner import Learner
from nfc_gym.inference.random import seeded
from nfc_gym.inference.space import PriorBox

Array = NDArray[np.float64]
_ROWS = 1024  # windows scored at once


@dataclass(frozen=True)
class FaultConfig:
    """What is built.

    Attributes:
      kinds: names of what windows are labelled by, the first without a fault.
      encoder: of the motion: tcn or nn.
      width: of the layers of the encoder `nn`.
      summaries: physics summaries beside the encoder.
      hidden: width of the last hidden layer.
    """

    kinds: tuple[str, ...] = ("none", "mass", "friction", "gain", "effect")
    encoder: str = "tcn"
    width: int = 1024
    summaries: bool = True
    hidden: int = 256
    elevation: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if isinstance(self.kinds, str) or len(set(self.kinds)) < 2 or len(set(self.kinds)) < len(self.kinds):
            raise InputError(f"fault classifier: kinds are two names or more, none twice, got {self.kinds!r}")
        object.__setattr__(self, "kinds", tuple(self.kinds))
        for name in ("width", "hidden"):
            require_whole(f"fault classifier: {name}", getattr(self, name), 1)

    def to_dict(self) -> dict[str, Any]:
        """Plain values that JSON holds."""
        return asdict(self)


class FaultClassifier(Learner):
    """Probabilities of the kinds of fault, given a window; a `WindowScore`.

    Args:
      config: what to build.
      sizes: of a window.
      prior: of the robot that windows are of.
      channels: names of the states' entries, kept in its file.
      seed: of the initial weights.
    """

    def __init__(
        self, config: FaultConfig, sizes: Sizes, prior: PriorBox, channels: tuple[str, ...] = (), seed: int = 0
    ) -> None:
        super().__init__()
        self.config, self.sizes, self.prior, self.channels = config, sizes, prior, tuple(channels)
        self.horizon, self.states, self.actions = sizes.horizon, sizes.states, sizes.actions
        plan = Regressions.of(sizes.layout, sizes.states, sizes.actions) if config.summaries else None
        with seeded(seed):
            self.place = Place(sizes.place) if sizes.place else nn.Identity()
            self.encoder = Joined(
                config.encoder, sizes.horizon, sizes.states, sizes.actions, width=config.width,
                summaries=config.summaries, regressions=plan,
            )  # fmt: skip
            self.kind = Structure(self.encoder.features, len(config.kinds), config.hidden)

    @torch.no_grad()
    def fit_scales(self, batch: Batch) -> None:
        """Scales of the encoder.

        Raises:
          InputError: the windows are of other sizes, or of kinds that it does not know.
        """
        checked(self, batch["states"].cpu(), batch["actions"].cpu())
        kinds = batch["family"]
        if len(odd := kinds[(kinds < 0) | (kinds >= len(self.config.kinds))]):
            raise InputError(
                f"windows: kind of fault {int(odd[0])}, and the classifier knows 0 to {len(self.config.kinds) - 1}: "
                f"{', '.join(self.config.kinds)}"
            )
        self.encoder.fit(self.place(batch["states"]), batch["actions"], None)

    def features(self, states: Tensor, actions: Tensor) -> Tensor:
        """(B, F) of windows (B, H+1, s), (B, H, a) as logged."""
        return self.encoder(self.place(states), actions)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Cross-entropy of the kinds of a batch."""
        found = self.features(batch["states"], batch["actions"])
        return {"kind": self.kind.loss(batch["family"], found).mean()}

    def score(self, states: Array, actions: Array) -> Array:
        """(n,) log odds of a fault, of windows (n, H+1, s), (n, H, a), or longer ones from their end.

        Raises:
          InputError: windows shorter than H, of other widths, or not finite.
        """
        logits = self._logits(states, actions)
        return np.logaddexp.reduce(logits[:, 1:], 1) - logits[:, 0]

    def told(self, states: Array, actions: Array) -> Array:
        """(n, kinds) probabilities; arguments and errors as of `score`."""
        logits = self._logits(states, actions)
        return np.exp(logits - np.logaddexp.reduce(logits, 1)[:, None])

    @torch.no_grad()
    def _logits(self, states: Array, actions: Array) -> Array:
        states, actions = checked(self, states, actions)
        if self.training:  # modules are walked through one by one
            self.eval()
        device = next(self.parameters()).device
        parts = [np.zeros((0, len(self.config.kinds)))]
        for at in range(0, len(states), _ROWS):
            pair = (torch.as_tensor(x[at : at + _ROWS], dtype=torch.float32, device=device) for x in (states, actions))
            parts.append(self.kind.layers(self.features(*pair)).double().cpu().numpy())
        return np.concatenate(parts)

    @classmethod
    def of(
        cls, batch: Mapping[str, Tensor], prior: PriorBox, config: FaultConfig | None = None,
        place: Mapping[str, Any] | None = None, **more: Any,
    ) -> "FaultClassifier":  # fmt: skip
        """One for windows like these; `place` as of `place_of(names)`, `more` as of the constructor."""
        return cls(config or FaultConfig(), Sizes.of(dict(batch), place=place), prior, **more)
