"""Windows of a benchmark: simulated once into a folder, then held on the device with fresh sensor noise each pass."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from torch import Tensor

from nfc_gym.inference.data import Batch, require_batch
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.windows import Windows
from nfc_gym.simulate import simulate
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.maps import keep_maps

TRAIN, JUDGE = 0, 1  # seeds of the windows that are learned from, and of those that judge
HALF = 0.5  # share of windows with an effect that the heads of residuals learn from
_MAPS = ("map", "delta_e")


def environment(robot: str, terrain: str) -> str:
    """Its id."""
    return f"nfc_gym/{robot}{terrain}-v0"


def prior_of(env: str) -> PriorBox:
    """Psi's box of an environment."""
    machine = Machine(env)
    return PriorBox.of(machine.space, machine.kind.name)


def folder_of(out: Path, env: str, windows: int, seed: int, effects: float) -> Path:
    """Where `stored` keeps windows."""
    name = env.removeprefix("nfc_gym/").removesuffix("-v0")
    return out / "windows" / f"{name}_{windows}_{seed}_{effects:g}"


def stored(
    out: Path, env: str, windows: int, seed: int, jobs: int, maps: bool = False, effects: float = 0.0
) -> Windows:  # fmt: skip
    """Windows of an environment under DIR, a share of them with an effect; what is not there yet is simulated."""
    folder = folder_of(out, env, windows, seed, effects)
    console = Console(stderr=True)
    found = simulate(env, windows, folder, seed=seed, jobs=jobs, effects=effects, console=console)
    if maps:
        keep_maps(folder, jobs, console)
        found = Windows(folder)
    return found


class Held:
    """Windows in memory, on any device. Each pass draws its sensor noise anew, a function of the pass's seed.

    Args:
      tensors: a batch of all windows, states free of noise.
      noise: (s,) standard deviation of each entry of the states.
      names: of the entries of the states.
    """

    def __init__(self, tensors: Batch, noise: Tensor, names: tuple[str, ...] = ()) -> None:
        self.tensors, self.noise, self.names, self.manifest = tensors, noise, names, {}

    @classmethod
    def of(cls, windows: Windows, device: torch.device, maps: bool = False) -> "Held":
        """All windows of a set."""
        names = ["states", "actions", "psi", "delta_s", "family", *(_MAPS if maps else ())]
        arrays = windows.take(np.arange(len(windows)), names)
        tensors = {k: torch.from_numpy(v) for k, v in arrays.items()}
        require_batch(tensors)
        noise = torch.tensor(windows.manifest.state_noise, dtype=torch.float32)
        small = {k: t.half() if k in _MAPS else t for k, t in tensors.items()}
        return cls({k: t.to(device) for k, t in small.items()}, noise.to(device), tuple(windows.manifest.state_names))

    def __len__(self) -> int:
        return len(self.tensors["psi"])

    def batches(self, size: int, seed: int | None) -> Iterator[Batch]:
        """See `nfc_gym.inference.data.WindowSet`; equal seeds give equal order and noise, None the stored order."""
        device = self.noise.device
        chance = torch.Generator(device).manual_seed(0 if seed is None else seed)
        every = torch.arange(len(self), device=device)
        order = every if seed is None else torch.randperm(len(self), generator=chance, device=device)
        for rows in order.split(size):
            yield self.take(rows, chance)

    def take(self, rows: Tensor, chance: torch.Generator) -> Batch:
        """Some windows, with noise from a generator."""
        batch = {k: t[rows] for k, t in self.tensors.items()}
        states = batch["states"]
        white = torch.randn(states.shape, generator=chance, device=states.device)
        return {k: t.float() if k in _MAPS else t for k, t in batch.items()} | {"states": states + self.noise * white}

    def noisy(self, seed: int = 0) -> Batch:
        """All of them, once, with one draw of noise."""
        return next(self.batches(len(self), None if seed == 0 else seed))

    def first(self, count: int) -> "Held":
        """The first windows, at most all."""
        return Held({k: t[:count] for k, t in self.tensors.items()}, self.noise, self.names)

    def split(self, share: float) -> tuple["Held", "Held"]:
        """The first windows, and the last `share` of them."""
        cut = len(self) - max(1, round(share * len(self)))
        parts = ({k: t[part] for k, t in self.tensors.items()} for part in (slice(cut), slice(cut, None)))
        first, last = (Held(p, self.noise, self.names) for p in parts)
        return first, last


@dataclass(frozen=True)
class Sets:
    """Windows of one environment to train on and to judge by; nothing is simulated or read before it is asked for.

    Attributes:
      out: DIR.
      env: id.
      train_on, judge_by: how many windows.
      effects: share of them with an effect.
      maps: whether they have maps.
      jobs: processes of the simulation.
      device: where they are held.
    """

    out: Path
    env: str
    train_on: int
    judge_by: int
    effects: float
    maps: bool
    jobs: int
    device: torch.device

    @cached_property
    def judged(self) -> Windows:
        """To judge by, as stored."""
        return stored(self.out, self.env, self.judge_by, JUDGE, self.jobs, self.maps, self.effects)

    @cached_property
    def judges(self) -> Held:
        """The same, held."""
        return Held.of(self.judged, self.device, self.maps)

    @cached_property
    def windows(self) -> Held:
        """To train on."""
        whole = stored(self.out, self.env, self.train_on, TRAIN, self.jobs, self.maps, self.effects)
        return Held.of(whole, self.device, self.maps)
