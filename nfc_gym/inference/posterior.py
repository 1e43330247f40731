"""`NeuralPosterior`: a trained network as core's `Posterior`, given a window of motion."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from nfc_gym.core.errors import InputError
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.core.whole import require_whole
from nfc_gym.inference import checkpoint
from nfc_gym.inference.memory import enough_memory
from nfc_gym.inference.network import Encoded, Network
from nfc_gym.inference.random import seeded
from nfc_gym.inference.replay import Passes
from nfc_gym.inference.space import PriorBox

Array = NDArray[np.float64]
_ROWS, _MAPS = 65536, 64  # samples that are drawn in one batch, without maps and with
_LARGEST = float(np.finfo(np.float32).max)  # in which networks compute


@dataclass(frozen=True)
class Window:
    """A stretch of motion to infer from, on the scales and in the order of the training set.

    Attributes:
      states: (H+1, s), or longer: the last H steps count.
      actions: (H, a), as long as the states less one.
      elevation: (128, 128) perceived heights in m, where the network was trained with maps.
    """

    states: ArrayLike
    actions: ArrayLike
    elevation: ArrayLike | None = None


def _numbers(name: str, value: ArrayLike) -> Array:
    """An array of its own: torch takes none that are read-only, or that run backwards."""
    try:
        return np.asarray(value, float).copy(order="C")
    except (TypeError, ValueError) as e:
        raise InputError(f"window: {name} must be an array of numbers ({e})") from None


class NeuralPosterior:
    """What a network believes about psi (and delta_s) before and after it sees a window.

    `given(window)` is the posterior; until then `sample` refuses. What the motion cannot show comes back as wide as the
    prior: a narrow posterior says that the window told, a wide one that it did not, and neither that the simulator
    behind the training set is right.

    Args:
      network: trained.
      kept: of the window it was given, one row.
      notes: kept in its file.
      parts: of a fidelity that its draws speak of; default all that the network infers.
      passes: of the network, from an earlier posterior of the same; what it captured for a GPU is used again.
    """

    def __init__(
        self, network: Network, kept: Encoded | None = None, notes: dict[str, Any] | None = None,
        parts: tuple[str, ...] = (), passes: Passes | None = None,
    ) -> None:  # fmt: skip
        self.parts = parts or network.parts
        self.passes = passes or Passes(network)
        if network.training:  # to walk all its modules for nothing took 0.7 ms of a shared core a window
            network.eval()
        self.network, self.kept, self.notes = network, kept, dict(notes or {})

    @property
    def prior(self) -> PriorBox:
        """Psi's box."""
        return self.network.prior

    @torch.no_grad()
    def given(self, window: Window) -> "NeuralPosterior":
        """The posterior given a window.

        Raises:
          InputError: the window is shorter than the network's, of other widths, not finite, or lacks the map.
        """
        states, actions, elevation = self._checked(window)
        device = next(self.network.parameters()).device

        def row(x: Array) -> Tensor:
            return torch.as_tensor(x, dtype=torch.float32, device=device)[None]

        kept = self.passes.encode(row(states), row(actions), None if elevation is None else row(elevation))
        return NeuralPosterior(self.network, kept, self.notes, self.parts, self.passes)

    def _checked(self, window: Window) -> tuple[Array, Array, Array | None]:
        size = self.network.sizes
        states, actions = _numbers("states", window.states), _numbers("actions", window.actions)
        for name, x, width in (("states", states, size.states), ("actions", actions, size.actions)):
            if x.ndim != 2 or x.shape[1] != width:
                raise InputError(
                    f"window: {name} must have shape (time, {width}), got {x.shape}; "
                    f"this posterior is of the robot {self.prior.robot!r}"
                )
        if len(states) != len(actions) + 1:
            raise InputError(f"window: n + 1 states go with n actions, got {len(states)} and {len(actions)}")
        if len(actions) < size.horizon:
            raise InputError(f"window: {len(actions)} steps; this network was trained on windows of {size.horizon}")
        states, actions = states[-size.horizon - 1 :], actions[len(actions) - size.horizon :]
        elevation = None
        if self.network.config.elevation:
            if window.elevation is None:
                raise InputError("window: this network was trained with an elevation map; give `elevation`")
            elevation = _numbers("elevation", window.elevation)
            if elevation.shape != (128, 128):
                raise InputError(f"window: elevation must have shape (128, 128), got {elevation.shape}")
        for name, x in (("states", states), ("actions", actions), ("elevation", elevation)):
            odd = np.empty(0) if x is None else x[~(np.abs(x) <= _LARGEST)]
            if len(odd):
                raise InputError(f"window: {name} holds {odd[0]:g}; every entry must be finite, also in float32")
        return states, actions, elevation

    def _require_settings(self, name: str, how: dict[str, Any], known: tuple[str, ...]) -> None:
        for odd in [key for key in how if key not in known]:
            raise InputError(
                f"{name}: {odd}= is no setting of the density {self.network.config.density!r}, "
                f"which takes {' and '.join(f'{key}=' for key in known) or 'none'}"
            )

    def _window(self) -> Encoded:
        if self.kept is None:
            raise InputError(
                f"the posterior of {self.prior.robot!r} was given no window: "
                "call posterior.given(Window(states, actions)), or write the posterior given one by "
                "`nfc-gym infer FILE window.npz --out given.safetensors`"
            )
        return self.kept

    def of(self, *parts: str) -> "NeuralPosterior":
        """The same, speaking of some parts alone: psi is drawn in milliseconds, delta_e in seconds.

        Raises:
          InputError: a part that the network does not infer, or psi is left out.
        """
        wrong = [p for p in parts if p not in self.network.parts]
        if wrong or "psi" not in parts:
            raise InputError(f"posterior: parts are psi and others of {', '.join(self.network.parts)}, got {parts}")
        return NeuralPosterior(self.network, self.kept, self.notes, parts, self.passes)

    @torch.no_grad()
    def sample(self, n: int, rng: np.random.Generator, **how: Any) -> Fidelity:
        """`n` draws of psi in physical units, and of the other `parts`.

        `how` goes to the density: `steps=` and `stochastic=True` of a score model.

        Raises:
          InputError: n is no whole number of 1 or more, `rng` draws no numbers, a setting that this density does not
            take, no window was given, or there is no memory for so many.
        """
        require_whole("sample: n", n, 1)
        if not isinstance(rng, np.random.Generator):
            raise InputError(f"sample: rng is {rng!r}, want a generator of numbers: numpy.random.default_rng(seed)")
        self._require_settings("sample", how, self.network.density.drawing)
        kept, maps = self._window(), None
        blocks = 2 if "delta_s" in self.parts else 1
        full = (
            f"sample: no memory for {n} draws on {kept.mean.device}: draw fewer at a time, or use .to('cpu') on a GPU"
        )
        with enough_memory(full), seeded(rng, kept.mean.device):
            if "delta_e" in self.parts:
                pairs = [self.network.sample_terrain(min(_MAPS, n - at), kept, **how) for at in range(0, n, _MAPS)]
                drawn = torch.cat([p[0] for p in pairs])
                maps = torch.cat([p[1] for p in pairs]).double().cpu().numpy()
            else:
                counts = [min(_ROWS, n - at) for at in range(0, n, _ROWS)]
                drawn = torch.cat([self.passes.sample(k, kept, blocks, **how)[0] for k in counts])
        psi, delta = self.prior.from_z(drawn[:, : self.prior.size].double().cpu().numpy()), None
        if blocks == 2:
            y = torch.where(self.network.varies, drawn[:, self.prior.size :], 0.0)
            seen = self.network.delta_scale.inverse(y)
            delta = self.network.faced(seen, kept.facing, back=True).double().cpu().numpy()
        return Fidelity(psi, delta, maps)

    @torch.no_grad()
    def log_prob(self, x: Fidelity, **how: Any) -> Array:
        """(n,) log density in nats, in the fidelity's own units: of psi alone, or of (psi, delta_s) where x holds both.

        It is that of the free parameters, minus infinity outside the prior's box. The prior's own log density is
        `-prior.log_volume`, so that `log_prob(x) + prior.log_volume` is what the window told about x. `how` goes to the
        density: `steps=` of a score model.

        Raises:
          InputError: x has no psi, holds what this network does not infer or of another width, a setting that this
            density does not take, no window was given, or there is no memory for so many.
        """
        self._require_settings("log_prob", how, self.network.density.judging)
        kept = self._window()
        if x.psi is None:
            raise InputError("log_prob: the density is of psi, or of psi and delta_s together; x has no psi")
        extra = [p for p in x.given if p not in self.network.blocks]
        if extra:
            raise InputError(f"log_prob: {extra[0]} has no density here; there is: {', '.join(self.network.blocks)}")
        if x.delta_s is not None and x.delta_s.shape[-1] != self.network.sizes.states:
            want = self.network.sizes.states
            raise InputError(f"log_prob: delta_s must end in {want} values, got shape {x.delta_s.shape}")
        psi = np.atleast_2d(x.psi)
        if not len(psi):
            return np.zeros(0)
        z, free = self.prior.to_z(psi), np.array(self.prior.free)
        u = self.prior.u_of(psi)[:, free]
        # density in u is that in z over N(z; 0, I)
        change = (z**2 + np.log(2 * np.pi)).sum(1) / 2 - self.prior.log_volume
        points = [torch.as_tensor(z, dtype=torch.float32, device=kept.mean.device)]
        if x.delta_s is not None:
            scale, varies = self.network.delta_scale, self.network.varies
            given = torch.as_tensor(np.array(x.delta_s, ndmin=2), dtype=torch.float32, device=kept.mean.device)
            delta = self.network.faced(given, kept.facing)  # at right angles: densities are the same
            points.append(torch.where(varies, scale(delta), 0.0))
            # a constant entry is N(0, 1) noise to the network, taken out at 0 again
            slope = torch.where(varies, scale.log_slope(delta), np.log(2 * np.pi) / 2).sum(1)
            change = change + slope.double().cpu().numpy()
        at = torch.cat(points, 1)
        with enough_memory(f"log_prob: no memory for {len(at)} points on {at.device}: ask for fewer at a time"):
            value = self.network.log_prob(at[None], kept, len(points), **how)[0]
        return np.where(((u < 0) | (u > 1)).any(1), -np.inf, value.double().cpu().numpy() + change)

    @torch.no_grad()
    def families(self) -> dict[str, float]:
        """Probability of each family of effects, where the network has a structure head.

        Raises:
          InputError: it has none, or was given no window.
        """
        if self.network.structure is None:
            raise InputError("this network was trained without a structure head")
        shares = self.network.structure(self._window().features)[0].tolist()
        return dict(zip(self.network.config.families, shares, strict=True))

    def to(self, device: str | torch.device) -> "NeuralPosterior":
        """The same on another device; the network moves."""
        kept = self.kept
        if kept is not None:
            seen = None if kept.elevation is None else kept.elevation.to(device)
            kept = Encoded(kept.features.to(device), kept.mean.to(device), kept.facing.to(device), seen)
        return NeuralPosterior(self.network.to(device), kept, self.notes, self.parts)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a checkpoint that `load` and `load_source` open; of a given window what is kept of it."""
        checkpoint.save(Path(path), self.network, given=self.kept, notes=self.notes)


def load(path: str | os.PathLike[str], prior: PriorBox | None = None) -> NeuralPosterior:
    """Open a posterior's checkpoint; with `prior`, one of another robot or prior is refused (see `checkpoint.load`)."""
    return NeuralPosterior(*checkpoint.load(Path(path), prior))
