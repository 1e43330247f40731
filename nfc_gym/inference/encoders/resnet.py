"""ResNet-18 for a map of heights."""

from torch import Tensor, nn

from nfc_gym.inference.encoders.base import Encoder, Standard

FEATURES, STAGES = 1024, (64, 128, 256, 512)


def norm(channels: int) -> nn.GroupNorm:
    """Normalisation that is the same in training and use, whatever the batch: no running statistics to average."""
    return nn.GroupNorm(min(32, channels // 2), channels)


class Basic(nn.Module):
    """Two 3 x 3 convolutions beside a residual path (He et al. 2016, figure 2)."""

    def __init__(self, inside: int, outside: int, stride: int) -> None:
        super().__init__()
        self.path = nn.Sequential(
            nn.Conv2d(inside, outside, 3, stride, 1, bias=False), norm(outside), nn.ReLU(),
            nn.Conv2d(outside, outside, 3, 1, 1, bias=False), norm(outside),
        )  # fmt: skip
        self.short = (
            nn.Identity()
            if stride == 1 and inside == outside
            else nn.Sequential(nn.Conv2d(inside, outside, 1, stride, bias=False), norm(outside))
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, inside, h, w) -> (B, outside, h / stride, w / stride)."""
        return nn.functional.relu(self.short(x) + self.path(x))


class ResNet18(Encoder):
    """Eighteen layers on one channel of heights; 512 pooled features, projected to the paper's 1024.

    Batch normalisation is replaced by group normalisation (Wu and He 2018). torchvision would bring a second compiled
    package for these sixty lines.
    """

    features = FEATURES

    def __init__(self) -> None:
        super().__init__()
        self.scale = Standard(1)
        sizes = (STAGES[0], *STAGES)
        blocks: list[nn.Module] = []
        for i, (a, b) in enumerate(zip(sizes, STAGES, strict=False)):
            blocks += [Basic(a, b, 1 if i == 0 else 2), Basic(b, b, 1)]
        self.stem = nn.Sequential(
            nn.Conv2d(1, STAGES[0], 7, 2, 3, bias=False), norm(STAGES[0]), nn.ReLU(), nn.MaxPool2d(3, 2, 1)
        )
        self.blocks = nn.Sequential(*blocks)
        self.project = nn.Linear(STAGES[-1], FEATURES)

    def fit(self, states: Tensor, actions: Tensor, elevation: Tensor | None) -> None:
        """The maps' scale."""
        if elevation is not None:
            self.scale.fit(elevation[..., None])

    def forward(self, states: Tensor, actions: Tensor, elevation: Tensor | None = None) -> Tensor:
        """(B, 1024) features of the maps (B, 128, 128) alone."""
        assert elevation is not None  # `Joined` has checked it
        x = self.scale(elevation[..., None]).movedim(-1, 1).clamp(-10, 10)
        return self.project(self.blocks(self.stem(x)).mean((-2, -1)))
