"""`Network`: encoder and heads on their scales, built from plain configuration."""

from functools import partial
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from nfc_gym.core.errors import InputError
from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.data import Batch
from nfc_gym.inference.encoders import Joined, Regressions
from nfc_gym.inference.encoders.base import TINY, Standard, Tamed
from nfc_gym.inference.encoders.place import Place
from nfc_gym.inference.heads.density import Chain, Density
from nfc_gym.inference.heads.flow import Flow
from nfc_gym.inference.heads.mixture import Mixture
from nfc_gym.inference.heads.score import Score
from nfc_gym.inference.heads.structure import Structure
from nfc_gym.inference.heads.terrain import CELLS, Terrain
from nfc_gym.inference.learner import Learner
from nfc_gym.inference.linear import LinearBase
from nfc_gym.inference.random import seeded
from nfc_gym.inference.space import EDGE, PriorBox

_CHUNK = 1024  # windows whose fixed features are computed at once


class Encoded(NamedTuple):
    """What a network keeps of B windows: `features` (B, F), and the linear base's `mean` (B, D), else zeros.

    `facing` (B, 3) says how the window lies in the world (`Place`), in whose frame delta_s is; `elevation`
    (B, 128, 128) is the scaled map, where delta_e is inferred.
    """

    features: Tensor
    mean: Tensor
    facing: Tensor
    elevation: Tensor | None = None


class Network(Learner):
    """From a window to densities over what made it.

    Args:
      config: what to build.
      sizes: of a window.
      prior: psi's box.
      seed: of the initial weights.

    Attributes:
      blocks: names of what the density is over: psi, and delta_s where it is inferred.
      parts: those, and delta_e where it is sampled too.
    """

    varies: Tensor
    free: Tensor

    def __init__(self, config: NetworkConfig, sizes: Sizes, prior: PriorBox, seed: int = 0) -> None:
        super().__init__()
        self.config, self.sizes, self.prior = config, sizes, prior
        self.blocks = ("psi", "delta_s") if config.delta_s else ("psi",)
        self.parts = (*self.blocks, "delta_e") if config.delta_e else self.blocks
        with seeded(seed):
            self.place = Place(sizes.place) if sizes.place else nn.Identity()
            plan = Regressions.of(sizes.layout, sizes.states, sizes.actions) if config.summaries else None
            self.encoder = Joined(
                config.encoder, sizes.horizon, sizes.states, sizes.actions, width=config.width,
                summaries=config.summaries, regressions=plan, elevation=config.elevation,
            )  # fmt: skip
            width = config.features or self.encoder.features
            self.project = nn.Linear(self.encoder.features, width) if config.features else nn.Identity()
            self.delta_scale = Tamed(sizes.states)
            self.register_buffer("varies", torch.ones(sizes.states, dtype=torch.bool))
            self.register_buffer("free", torch.tensor(prior.free).nonzero()[:, 0], persistent=False)
            self.density = self._density(width)
            size = self.density.width(None)
            self.terrain = Terrain(width, size, config.hidden) if config.delta_e else None
            self.map_scale = Standard(1) if config.delta_e else None
            self.base = LinearBase(self.encoder.fixed_size, size) if config.linear else None
            self.structure = Structure(width, len(config.families), config.hidden) if config.families else None

    def _density(self, features: int) -> Density:
        c = self.config
        widths = [self.prior.size, self.sizes.states][: len(self.blocks)]
        if c.density == "score":
            return Score(widths, features, c.hidden, c.depth, c.dropout, c.draws)
        if c.density == "mixture":
            return Chain(widths, features, partial(Mixture, hidden=c.hidden, components=c.components))
        return Chain(widths, features, partial(Flow, hidden=c.hidden, transforms=c.depth))

    @torch.no_grad()
    def fit_scales(self, batch: Batch) -> None:
        """Take scales of inputs and of delta_s from windows of the training set.

        Raises:
          InputError: the windows are of other sizes than the network, or lack what it infers.
        """
        self.require(batch)
        if self.config.delta_s:
            batch = batch | {"delta_s": self.faced(batch["delta_s"], self.facing(batch["states"]))}
        batch = batch | {"states": self.place(batch["states"])}
        self.encoder.fit(batch["states"], batch["actions"], batch.get("map"))
        if self.config.delta_s:
            self.delta_scale.fit(batch["delta_s"])
            flat = batch["delta_s"]
            self.varies.copy_(flat.std(0, correction=0) > TINY * (1 + flat.mean(0).abs()))
        if self.terrain is not None and self.map_scale is not None:
            self.map_scale.fit(batch["map"][..., None])
            self.terrain.waves.fit(batch["delta_e"])
        if self.base is not None:
            parts = zip(batch["states"].split(_CHUNK), batch["actions"].split(_CHUNK), strict=True)
            with seeded(0):
                self.base.fit(torch.cat([self.encoder.fixed(s, a) for s, a in parts]), self.targets(batch))
            if self.config.delta_s:
                psi = torch.zeros(self.prior.size, dtype=torch.bool, device=self.varies.device)
                self.base.leave(torch.cat([psi, ~self.varies]))

    def require(self, batch: Batch) -> None:
        """Refuse windows that are not this network's.

        Raises:
          InputError: see `fit_scales`.
        """
        got, want = Sizes.of(batch), self.sizes
        for name in ("horizon", "states", "actions"):
            if getattr(got, name) != getattr(want, name):
                raise InputError(f"windows: {name} is {getattr(got, name)}, the network's is {getattr(want, name)}")
        if batch["psi"].shape[1] != len(self.prior):
            raise InputError(
                f"windows: psi has {batch['psi'].shape[1]} entries; the prior of {self.prior.robot!r} has "
                f"{len(self.prior)}: {', '.join(self.prior.names)}"
            )
        for name, wanted in (
            ("delta_s", self.config.delta_s), ("map", self.config.elevation), ("family", self.structure is not None),
            ("delta_e", self.config.delta_e),
        ):  # fmt: skip
            if wanted and name not in batch:
                raise InputError(f"windows: the network needs {name!r}; the set has: {', '.join(batch)}")
        if self.config.delta_s and batch["delta_s"].shape[1] != want.states:
            raise InputError(f"windows: delta_s has {batch['delta_s'].shape[1]} entries, states have {want.states}")
        if self.structure is not None:
            known, odd = len(self.config.families), batch["family"]
            if len(odd := odd[(odd < 0) | (odd >= known)]):
                raise InputError(
                    f"windows: family {int(odd[0])}, and the network has {known}, 0 to {known - 1}: "
                    f"{', '.join(self.config.families)}"
                )
        for name in ("map", "delta_e") if self.config.elevation else ():
            if name in batch and batch[name].shape[1:] != (CELLS, CELLS):
                raise InputError(f"windows: {name} has shape {tuple(batch[name].shape)}, want (n, {CELLS}, {CELLS})")

    @torch.no_grad()
    def unlike(self, states: Tensor) -> Tensor:
        """(s,) spreads that the median of each state of one window (H+1, s), as logged, lies from the training set's.

        It is 0 throughout where no encoder sees the states themselves.
        """
        signals = self.encoder.signals
        device = self.free.device
        if signals is None:
            return torch.zeros(states.shape[1], device=device)
        return signals.far(self.place(states[None].to(device))[0])

    def facing(self, states: Tensor) -> Tensor:
        """(B, 3) how windows as logged lie in the world, see `Place`; ahead where their place is not told."""
        if isinstance(self.place, Place):
            return self.place.facing(states)
        ahead = states.new_zeros(len(states), 3)
        ahead[:, ::2] = 1
        return ahead

    def faced(self, delta_s: Tensor, facing: Tensor, back: bool = False) -> Tensor:
        """delta_s (..., s) in the frame that the encoder sees its window in, or back in the world's.

        A window looks the same wherever it happens: what in the world's frame depends on its heading, as the direction
        in which a push moves the robot does, could not be told from it.
        """
        return self.place.turned(delta_s, facing, back) if isinstance(self.place, Place) else delta_s

    def encode(self, states: Tensor, actions: Tensor, elevation: Tensor | None = None) -> Encoded:
        """What is kept of windows as logged."""
        facing = self.facing(states)
        states = self.place(states)
        features = self.project(self.encoder(states, actions, elevation))
        seen = None
        if self.map_scale is not None and elevation is not None:
            seen = self.map_scale(elevation[..., None])[..., 0].clamp(-10, 10)
        if self.base is None:
            return Encoded(features, states.new_zeros(len(states), self.density.width(None)), facing, seen)
        with torch.autocast(states.device.type, enabled=False):  # a narrow posterior's mean needs all its digits
            return Encoded(features, self.base(self.encoder.fixed(states, actions)), facing, seen)

    def sample(self, n: int, given: Encoded, blocks: int | None = None, **how: Any) -> Tensor:
        """(B, n, width of the first `blocks` blocks) draws of what `targets` are; `how` goes to the density."""
        y = self.density.sample(n, given.features, blocks, **how)
        return y if self.base is None else self.base.colour(y, given.mean[:, None])

    def sample_terrain(self, n: int, given: Encoded, **how: Any) -> tuple[Tensor, Tensor]:
        """Joint draws given one window: (n, D) of what `targets` are, and delta_e (n, 128, 128) in m."""
        assert self.terrain is not None  # the caller has asked whether delta_e is inferred
        assert given.elevation is not None
        y, m = self.terrain.sample(n, given.features, given.elevation, cast(Score, self.density), **how)
        return (y if self.base is None else self.base.colour(y, given.mean)), m

    def log_prob(self, x: Tensor, given: Encoded, blocks: int | None = None, **how: Any) -> Tensor:
        """(B, n) log density at x (B, n, width of the first `blocks` blocks)."""
        if self.base is None:
            return self.density.log_prob(x, given.features, blocks, **how)
        y = self.base.whiten(x, given.mean[:, None])
        return self.density.log_prob(y, given.features, blocks, **how) - self.base.log_scale(x.shape[-1])

    def targets(self, batch: Batch) -> Tensor:
        """(B, D) what the density is over: z of the free psi, then delta_s in its window's frame on its tamed scale.

        Entries of delta_s that never vary in training are N(0, 1) noise here, and come back as the constant they are.
        """
        parts = [torch.special.ndtri(batch["psi"][:, self.free].clamp(EDGE, 1 - EDGE))]
        if self.config.delta_s:
            scaled = self.delta_scale(self.faced(batch["delta_s"], self.facing(batch["states"])))
            parts.append(torch.where(self.varies, scaled, torch.randn_like(scaled)))
        return torch.cat(parts, 1)

    @torch.no_grad()
    def calibrate(self, batch: Batch) -> None:
        """Take the density's width from windows that were not trained on, see `Density.calibrate`."""
        x, maps = self.targets(batch), batch.get("map")
        each = zip(
            batch["states"].split(_CHUNK), batch["actions"].split(_CHUNK),
            [None] * len(x) if maps is None else maps.split(_CHUNK), strict=False,
        )  # fmt: skip
        given = [self.encode(*part) for part in each]
        features, mean = (torch.cat([getattr(g, name) for g in given]) for name in ("features", "mean"))
        self.density.calibrate(x if self.base is None else self.base.whiten(x, mean), features)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Mean loss of each head over a batch; their sum is what training brings down."""
        given = self.encode(batch["states"], batch["actions"], batch.get("map"))
        x = self.targets(batch)
        y = x if self.base is None else self.base.whiten(x, given.mean)
        out = {"density": self.density.loss(y[:, None], given.features).mean()}
        if self.terrain is not None and given.elevation is not None:
            m = self.terrain.waves(batch["delta_e"])
            score = cast(Score, self.density)
            out["terrain"] = self.terrain.loss(y, m, given.features, given.elevation, score).mean()
        if self.structure is not None:
            out["structure"] = cast(Structure, self.structure).loss(batch["family"], given.features).mean()
        return out
