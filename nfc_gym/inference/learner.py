"""What the training loop asks of a network."""

from typing import Any

from torch import Tensor, nn

from nfc_gym.inference.data import Batch
from nfc_gym.inference.space import PriorBox


class Learner(nn.Module):
    """A network that the training loop can train.

    Attributes:
      config: plain configuration: `to_dict()`, and `elevation`, whether windows come with maps.
      prior: whose windows it is for.
    """

    config: Any
    prior: PriorBox

    def fit_scales(self, batch: Batch) -> None:
        """Take scales from windows of the training set."""
        raise NotImplementedError

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Mean losses over a batch; their sum is what training brings down."""
        raise NotImplementedError
