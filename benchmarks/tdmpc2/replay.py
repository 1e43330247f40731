"""Sequences of steps that are learned from again and again: each as long as the horizon, none across two episodes."""

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .settings import Settings
from .world_model import Sizes

Array = NDArray[np.float32]


class Windows:
    """The last steps of n simulations, from which every control step completes one sequence of each.

    A simulation gives none until it has taken as many steps in its episode as the horizon has. One that ended early
    ends the sequence that it gives then, so an end is always a sequence's last step.

    Args:
      rows: n.
      sizes, horizon: of observations, actions and sequences.
    """

    def __init__(self, rows: int, sizes: Sizes, horizon: int) -> None:
        self.horizon = horizon
        self.observations = np.zeros((rows, horizon + 1, sizes.observation), np.float32)
        self.actions = np.zeros((rows, horizon, sizes.action), np.float32)
        self.rewards = np.zeros((rows, horizon), np.float32)
        self.ended = np.zeros((rows, horizon), bool)
        self.taken = np.zeros(rows, int)

    def begin(self, observations: Array, which: NDArray[np.bool_]) -> None:
        """Episodes that begin, with the first observations (n, o) of all rows."""
        self.observations[which, -1] = observations[which]
        self.taken[which] = 0

    def step(
        self, actions: Array, rewards: Array, ended: NDArray[np.bool_], observations: Array
    ) -> dict[str, Tensor] | None:
        """A step of all of them; the sequences (m, ...) that are complete by it, or None.

        Returns:
          `observation` (m, horizon + 1, o), `action` (m, horizon, a), `reward` and `ended` (m, horizon).
        """
        news = ((self.observations, observations), (self.actions, actions), (self.rewards, rewards),
                (self.ended, ended))  # fmt: skip
        for kept, new in news:
            kept[:, :-1] = kept[:, 1:].copy()
            kept[:, -1] = new
        self.taken += 1
        full = self.taken >= self.horizon
        if not full.any():
            return None
        parts = {"observation": self.observations, "action": self.actions, "reward": self.rewards, "ended": self.ended}
        return {k: torch.from_numpy(v[full]) for k, v in parts.items()}


class Replay:
    """All sequences so far, on the device that learns from them: nothing waits for the processor to draw a batch.

    Args:
      settings: of them capacity and batch are used.
      device: where they are kept.
      most: how many there can be at most; None is the capacity.
    """

    def __init__(self, settings: Settings, device: torch.device, most: int | None = None) -> None:
        self.capacity = settings.capacity if most is None else max(1, min(settings.capacity, most))
        self.device, self.batch = device, settings.batch
        self._kept: dict[str, Tensor] = {}
        self._size = self._next = 0

    def __len__(self) -> int:
        return self._size

    def add(self, sequences: Mapping[str, Tensor] | None) -> None:
        """Keep some more (m, ...); the oldest make room."""
        if sequences is None:
            return
        for name, new in sequences.items():
            if name not in self._kept:
                self._kept[name] = torch.empty(self.capacity, *new.shape[1:], dtype=new.dtype, device=self.device)
        m = len(next(iter(sequences.values())))
        kept = min(m, self.capacity)  # of more than there is room for, the last ones
        where = (self._next + m - kept + torch.arange(kept, device=self.device)) % self.capacity
        for name, new in sequences.items():
            self._kept[name].index_copy_(0, where, new[m - kept :].to(self.device))
        self._next = (self._next + m) % self.capacity
        self._size = min(self._size + m, self.capacity)

    def sample(self) -> dict[str, Tensor]:
        """A batch, each sequence as likely as any other."""
        rows = torch.randint(self._size, (self.batch,), device=self.device)
        return {name: kept[rows] for name, kept in self._kept.items()}

    def contents(self) -> dict[str, Tensor]:
        """All of them, oldest first where nothing had to make room yet."""
        return {name: kept[: self._size] for name, kept in self._kept.items()}
