"""A problem in closed form, as windows: x = A z + noise, one state a window and no action."""

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.data import TensorWindows
from nfc_gym.inference.network import Network
from nfc_gym.inference.space import PriorBox

NOISE = 0.5
SMALL = {"encoder": "nn", "width": 32, "features": 0, "hidden": 32, "depth": 2}


def box(size: int = 3, robot: str = "toy") -> PriorBox:
    """Parameters of different scales."""
    low, high = np.linspace(-1, 1, size), np.linspace(0, 4, size)
    return PriorBox(robot, tuple(f"p{i}" for i in range(size)), ("kg",) * size, tuple(low), tuple(high))


def mix(size: int) -> Tensor:
    """A (size, size) well-conditioned matrix."""
    return torch.eye(size) + 0.3 * torch.randn(size, size, generator=torch.Generator().manual_seed(7)) / size**0.5


def linear_windows(n: int, size: int = 3, seed: int = 0, a: Tensor | None = None) -> TensorWindows:
    """`n` pairs of z ~ N(0, I) and x, by A = `mix(size)` or another."""
    g = torch.Generator().manual_seed(seed)
    z = torch.randn(n, size, generator=g)
    x = z @ (mix(size) if a is None else a).T + NOISE * torch.randn(n, size, generator=g)
    return TensorWindows({"states": x[:, None], "actions": torch.zeros(n, 0, 0), "psi": torch.special.ndtr(z)})


def gaussian(x: Tensor, a: Tensor | None = None) -> torch.distributions.MultivariateNormal:
    """The posterior of z given x (..., size), by the A of `linear_windows`."""
    a = mix(x.shape[-1]) if a is None else a
    covariance = torch.linalg.inv(torch.eye(len(a)) + a.T @ a / NOISE**2)
    return torch.distributions.MultivariateNormal(x @ a / NOISE**2 @ covariance, covariance)


def motion_windows(n: int, seed: int = 0, **more: Tensor) -> TensorWindows:
    """A cart of unknown mass and damping, pushed at random: H = 10, s = 2 (position, velocity), a = 1, d = 2.

    Half of the windows have a constant extra force, family 1, whose effect is delta_s.
    """
    g = torch.Generator().manual_seed(seed)
    u = torch.rand(n, 2, generator=g)
    mass, damping = 0.5 + u[:, 0], 2 * u[:, 1]
    family = torch.randint(2, (n,), generator=g)
    extra = 0.05 * torch.randn(n, generator=g) * family
    actions = torch.randn(n, 10, 1, generator=g)
    states = [torch.randn(n, 2, generator=g)]
    for t in range(10):
        position, velocity = states[-1].unbind(1)
        speed = velocity + 0.1 * (actions[:, t, 0] - damping * velocity) / mass + extra
        states.append(torch.stack([position + 0.1 * speed, speed], 1))
    delta = torch.stack([0.1 * extra, extra], 1)
    return TensorWindows({
        "states": torch.stack(states, 1), "actions": actions, "psi": u, "delta_s": delta,
        "family": family.to(torch.int16), **more,
    })  # fmt: skip


def killed(windows: TensorWindows, at: int) -> TensorWindows:
    """The same windows; reading their `at`-th batch, counted from 1 over all epochs, stops everything."""
    left = at

    class Killed(type(windows)):  # type: ignore[misc]
        def batches(self, size: int, seed: int | None) -> Iterator[dict[str, Tensor]]:
            nonlocal left
            for batch in super().batches(size, seed):
                left -= 1
                if not left:
                    raise KeyboardInterrupt
                yield batch

    return Killed(windows.tensors)


def network(windows: TensorWindows, prior: PriorBox | None = None, seed: int = 0, **config: object) -> Network:
    """A small network for these windows, its scales taken from them."""
    prior = prior or box(windows.tensors["psi"].shape[1])
    made = Network(NetworkConfig(**{**SMALL, **config}), Sizes.of(windows.tensors), prior, seed)  # type: ignore[arg-type]
    made.fit_scales(windows.tensors)
    return made.eval()
