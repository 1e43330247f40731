"""delta_e beside (psi, delta_s): the joint diffusion of a vector and a map, both at the same time."""

import torch
from torch import Tensor, nn

from nfc_gym.inference.heads import diffusion
from nfc_gym.inference.heads.score import Score, time_features
from nfc_gym.inference.heads.unet import UNet
from nfc_gym.inference.heads.waves import Waves

CELLS = 128


class Terrain(nn.Module):
    """The score of the residual terrain, and what the noised terrain tells the score of the vector.

    The joint density of y = (psi, delta_s) and the map's waves m diffuses as one: at angle phi the U-Net sees the
    noised waves, the map that they are, the perceived elevation, the features and the noised y; the vector's score
    model sees the noised y and a summary of the noised map, added to its condition. Without the summary that score is
    the one of y alone, whose density stays exact; m is sampled and has no density.

    Args:
      features: F.
      size: D of y.
      hidden: width of the condition.

    Attributes:
      waves: between maps in m and their waves; its scales are the training set's.
    """

    def __init__(self, features: int, size: int, hidden: int = 256) -> None:
        super().__init__()
        self.condition = nn.Linear(features, hidden)
        self.time = nn.Linear(32, hidden)
        self.vector = nn.Linear(size, hidden)
        self.waves = Waves(CELLS)
        self.unet = UNet(3, hidden)
        self.tell = nn.Sequential(nn.Linear(UNet.summary, hidden), nn.SiLU(), nn.Linear(hidden, hidden))

    def v(
        self, both: tuple[Tensor, Tensor], phi: Tensor, features: Tensor, elevation: Tensor, score: Score
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """v of y (B, D) and of m (B, 128, 128) at angles phi (B,)."""
        y, m = both
        condition = nn.functional.silu(self.condition(features) + self.time(time_features(phi)) + self.vector(y))
        of_map, summary = self.unet(torch.stack([m, self.waves.colour(m), elevation], 1), condition)
        count = torch.full((), len(score.sizes), device=y.device)
        modulations = score.modulations(phi, score.condition(features) + self.tell(summary), count)
        return score.v(y, score.here(count), modulations), of_map

    def loss(self, y: Tensor, m: Tensor, features: Tensor, elevation: Tensor, score: Score) -> Tensor:
        """(B,) mean square error of v: of the vector's entries, plus of the waves, plus of the map that they are.

        Waves alone would leave the coarse ones, which are few and make the map, to one part in thousands of the loss.
        """
        phi = diffusion.FLOOR + (diffusion.MOST - diffusion.FLOOR) * torch.rand(len(y), device=y.device).pow(1.5)
        noise = (torch.randn_like(y), torch.randn_like(m))
        c, s = phi.cos(), phi.sin()
        clean = (y, m)
        at = [_times(c, x) + _times(s, e) for x, e in zip(clean, noise, strict=True)]
        guess = self.v((at[0], at[1]), phi, features, elevation, score)
        away = [g - (_times(c, e) - _times(s, x)) for g, x, e in zip(guess, clean, noise, strict=True)]
        return _mean_square(away[0]) + _mean_square(away[1]) + _mean_square(self.waves.colour(away[1]))

    def sample(
        self, n: int, features: Tensor, elevation: Tensor, score: Score, *, steps: int = 10, stochastic: bool = False
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Draws (n, D) of y and (n, 128, 128) of maps [m] given a window: features (1, F), elevation (1, 128, 128)."""
        d = score.width(None)
        features, elevation = features.expand(n, -1), elevation.expand(n, -1, -1)

        def on(grid: Tensor) -> diffusion.Field:
            def field(x: Tensor, i: int) -> Tensor:
                both = (x[:, :d], x[:, d:].view(n, CELLS, CELLS))
                of_y, of_m = self.v(both, grid[i].expand(n), features, elevation, score)
                return torch.cat([of_y, of_m.flatten(1)], 1)

            return field

        noise = torch.randn(n, d + CELLS**2, device=features.device)
        x = diffusion.reverse_sde(on, noise, 10 * steps) if stochastic else diffusion.flow(on, noise, steps)
        return x[:, :d], self.waves.inverse(x[:, d:].view(n, CELLS, CELLS))


def _mean_square(x: Tensor) -> Tensor:
    return x.square().flatten(1).mean(1)


def _times(a: Tensor, x: Tensor) -> Tensor:
    return a.view(-1, *[1] * (x.ndim - 1)) * x
