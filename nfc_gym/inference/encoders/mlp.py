"""The vanilla network that the paper compares with (NN)."""

from torch import Tensor, nn

from nfc_gym.inference.encoders.base import SignalEncoder


class MLP(SignalEncoder):
    """Two hidden layers on the flattened window.

    Args:
      horizon: H.
      states: s.
      actions: a.
      width: of the layers, and the number of features.
    """

    def __init__(self, horizon: int, states: int, actions: int, width: int = 1024) -> None:
        super().__init__(horizon, states, actions)
        self.features = width
        self.layers = nn.Sequential(
            nn.Linear(self.length * self.channels, width), nn.GELU(), nn.Linear(width, width), nn.GELU()
        )

    def embed(self, x: Tensor) -> Tensor:
        """(B, H+1, channels) -> (B, width)."""
        return self.layers(x.flatten(1))
