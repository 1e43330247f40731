"""The conditional score model of psi and delta_s: an adaLN residual network that predicts v of `diffusion`."""

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from nfc_gym.inference.heads import diffusion
from nfc_gym.inference.heads.density import Density

_WAVES = 8
_NOISIEST = diffusion.MOST - 0.01  # rad
# Numbers that one chunk of `log_prob` may hold in a hidden layer's derivatives, and windows whose modulations are held
# at once: on a processor, and on a GPU, where a chunk takes the same time whatever its size.
_ROOM, _WINDOWS = {False: 2**24, True: 2**28}, {False: 256, True: 1024}


def time_features(phi: Tensor) -> Tensor:
    """(..., 32) waves of the angle and of its log noise-to-signal ratio: a network reads phi from them at any scale.

    The ratio ends at `_NOISIEST`. Beyond it a network sees one training draw in 250, and at pi / 2, where every draw
    begins, its tangent is infinite: in float32 pi / 2 is rounded up, and the tangent there is negative.
    """
    scales = 2.0 ** torch.arange(_WAVES, device=phi.device, dtype=phi.dtype)
    ratio = phi.clamp(1e-4, _NOISIEST).tan().log()[..., None] * scales / 32
    phase = torch.cat([phi[..., None] * scales, ratio], -1)
    return torch.cat([phase.sin(), phase.cos()], -1)


class Block(nn.Module):
    """A residual block that the condition scales, shifts and gates (adaLN-zero: Peebles and Xie 2023)."""

    def __init__(self, hidden: int, dropout: float) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(hidden, elementwise_affine=False)
        self.path = nn.Sequential(
            nn.Linear(hidden, hidden), nn.SiLU(), nn.Dropout(dropout), nn.Linear(hidden, hidden)
        )  # fmt: skip
        self.modulate = nn.Linear(hidden, 3 * hidden)
        nn.init.zeros_(self.modulate.weight)
        nn.init.zeros_(self.modulate.bias)

    def modulation(self, condition: Tensor) -> Tensor:
        """(..., 3 hidden) shift, scale and gate of a condition (..., hidden), the scale about 1."""
        shift, scale, gate = self.modulate(condition).chunk(3, -1)
        return torch.cat([shift, 1 + scale, gate], -1)

    def forward(self, h: Tensor, modulation: Tensor) -> Tensor:
        """The shape of h; the modulation is broadcast against it."""
        shift, scale, gate = modulation.chunk(3, -1)
        return torch.addcmul(h, gate, self.path(torch.addcmul(shift, self.norm(h), scale)))


class Score(Density):
    """A diffusion posterior of the blocks, all noised at the same time.

    With more than one block, half of the training draws see the first block alone (the others absent and flagged so),
    so that one network holds the joint density of (psi, delta_s) and that of psi, both exactly evaluated.
    The output is a network's plus a linear map of each coordinate, a(c, phi) x + b(c, phi): of a Gaussian posterior v
    is linear, and the network is left with what is not. All of it starts at 0, which is the prior.

    Args:
      sizes: width of each block.
      features: F.
      hidden: width of the layers.
      depth: number of residual blocks.
      dropout: in the blocks, while training.
      draws: noise draws for each point and step; the encoder runs once for all of them.
    """

    drawing = ("steps", "stochastic")
    judging = ("steps",)

    def __init__(
        self, sizes: Sequence[int], features: int, hidden: int = 256, depth: int = 4, dropout: float = 0.0,
        draws: int = 4,
    ) -> None:  # fmt: skip
        super().__init__(sizes, features)
        self.draws, self.hidden = draws, hidden
        d = sum(sizes)
        self.condition = nn.Sequential(nn.Linear(features, hidden), nn.SiLU(), nn.Linear(hidden, hidden))
        self.time = nn.Sequential(nn.Linear(4 * _WAVES, hidden), nn.SiLU(), nn.Linear(hidden, hidden))
        self.present = nn.Linear(len(sizes), hidden, bias=False)
        self.first = nn.Linear(d, hidden)
        self.blocks = nn.ModuleList([Block(hidden, dropout) for _ in range(depth)])
        self.last = nn.Linear(hidden, d)
        self.affine = nn.Linear(hidden, 2 * d)
        for layer in (self.last, self.affine):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        starts = torch.cat([torch.full((s,), i) for i, s in enumerate(sizes)])
        self.register_buffer("block_of", starts, persistent=False)

    def modulations(self, phi: Tensor, condition: Tensor, blocks: Tensor) -> tuple[Tensor, ...]:
        """What the window, the angle and the number of present blocks make of each layer; all three are broadcast."""
        flags = (torch.arange(len(self.sizes), device=phi.device) < blocks[..., None]).to(phi.dtype)
        c = nn.functional.silu(condition + self.time(time_features(phi)) + self.present(flags))
        return (*(cast(Block, b).modulation(c) for b in self.blocks), self.affine(c))

    def v(self, x: Tensor, here: Tensor | None, modulations: Sequence[Tensor]) -> Tensor:
        """v (..., d) at x; `here` is 1 for entries of blocks that are present, None where all are."""
        x = x if here is None else x * here
        h = self.first(x)
        for block, modulation in zip(self.blocks, modulations, strict=False):
            h = block(h, modulation)
        slope, offset = modulations[-1].chunk(2, -1)
        v = torch.addcmul(self.last(nn.functional.silu(h)) + offset, slope, x)
        return v if here is None else v * here

    def here(self, blocks: Tensor) -> Tensor:
        """(..., d) 1 for entries of the first `blocks` blocks, else 0."""
        return (cast(Tensor, self.block_of) < blocks[..., None]).float()

    def loss(self, x: Tensor, features: Tensor) -> Tensor:
        """(B,) mean square error of v, over noise at stratified angles."""
        b = len(x)
        x = x.repeat_interleave(self.draws, 1)
        n = x.shape[1]
        strata = (torch.randperm(b * n, device=x.device).view(b, n) + torch.rand(b, n, device=x.device)) / (b * n)
        phi = diffusion.FLOOR + (diffusion.MOST - diffusion.FLOOR) * strata.pow(1.5)
        blocks = torch.full((b, n), len(self.sizes), device=x.device)
        if len(self.sizes) > 1:
            blocks[torch.rand(b, n, device=x.device) < 0.5] = 1
        noise = torch.randn_like(x)
        c, s = phi.cos()[..., None], phi.sin()[..., None]
        here = self.here(blocks)
        modulations = self.modulations(phi, self.condition(features)[:, None], blocks)
        wrong = (self.v(c * x + s * noise, here, modulations) - (c * noise - s * x)).square() * here
        return wrong.sum(-1).mean(1) / x.shape[-1]

    def field(self, features: Tensor, blocks: int | None) -> diffusion.On:
        """v on a grid of angles, as a function of x (B, n, width of the blocks)."""
        condition = self.condition(features)[:, None]
        width, rest = self.width(blocks), self.width(None) - self.width(blocks)
        count = torch.full((), len(self.sizes) if blocks is None else blocks, device=features.device)
        here = self.here(count) if rest else None

        def on(grid: Tensor) -> diffusion.Field:
            every = self.modulations(grid[:, None, None], condition, count)  # (angles, B, 1, ...)

            def field(x: Tensor, i: int) -> Tensor:
                whole = nn.functional.pad(x, (0, rest)) if rest else x
                return self.v(whole, here, [m[i] for m in every])[..., :width]

            return field

        return on

    def sample(
        self, n: int, features: Tensor, blocks: int | None = None, *, steps: int = 10, stochastic: bool = False
    ) -> Tensor:  # fmt: skip
        """(B, n, width) draws by the ODE, or by the reverse SDE in ten times the steps."""
        out = []
        for part in features.split(_WINDOWS[features.is_cuda]):
            noise = torch.randn(len(part), n, self.width(blocks), device=features.device)
            field = self.field(part, blocks)
            drawn = (
                diffusion.reverse_sde(field, noise, 10 * steps) if stochastic else diffusion.flow(field, noise, steps)
            )
            out.append(drawn)
        return torch.cat(out)

    def log_prob(self, x: Tensor, features: Tensor, blocks: int | None = None, *, steps: int = 16) -> Tensor:
        """(B, n) log density by the ODE."""
        each = x.shape[2] * self.hidden  # numbers in one hidden layer's derivatives at one point
        room = _ROOM[x.is_cuda]
        points = max(1, min(x.shape[1], room // each))
        rows = max(1, min(_WINDOWS[x.is_cuda], room // (each * points)))
        out = []
        for part, some in zip(x.split(rows), features.split(rows), strict=True):
            field = self.field(some, blocks)
            out.append(torch.cat([diffusion.log_density(field, p, steps) for p in part.split(points, 1)], 1))
        return torch.cat(out)
