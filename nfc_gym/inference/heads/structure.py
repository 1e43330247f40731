"""Which family of effects a window betrays: the structure head."""

from torch import Tensor, nn


class Structure(nn.Module):
    """Probabilities of the families of effects, the first being none.

    Args:
      features: F.
      families: how many, none included.
      hidden: width of the hidden layer.
    """

    def __init__(self, features: int, families: int, hidden: int = 256) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(features, hidden), nn.GELU(), nn.Linear(hidden, families))

    def loss(self, family: Tensor, features: Tensor) -> Tensor:
        """(B,) cross-entropy of the injected families (B,)."""
        return nn.functional.cross_entropy(self.layers(features).float(), family.long(), reduction="none")

    def forward(self, features: Tensor) -> Tensor:
        """(B, families) probabilities."""
        return self.layers(features).float().softmax(-1)
