"""Sequences of steps in TorchRL's replay buffer: each as long as the horizon, none across two episodes."""

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer

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

    def step(self, actions: Array, rewards: Array, ended: NDArray[np.bool_], observations: Array) -> TensorDict | None:
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
        return TensorDict({k: torch.from_numpy(v[full]) for k, v in parts.items()}, [int(full.sum())])


class Replay:
    """All sequences so far.

    Args:
      settings: of them capacity and batch are used.
      device: where they are kept.
      most: how many there can be at most; None is the capacity.
    """

    def __init__(self, settings: Settings, device: torch.device, most: int | None = None) -> None:
        capacity = settings.capacity if most is None else max(1, min(settings.capacity, most))
        self.device = device
        self.buffer = ReplayBuffer(storage=LazyTensorStorage(capacity, device=device), batch_size=settings.batch)

    def __len__(self) -> int:
        return len(self.buffer)

    def add(self, sequences: TensorDictBase | None) -> None:
        """Keep some more; the oldest make room."""
        if sequences is not None:
            self.buffer.extend(sequences.to(self.device))

    def sample(self) -> TensorDictBase:
        """A batch, each sequence as likely as any other."""
        return self.buffer.sample()

    def contents(self) -> dict[str, torch.Tensor]:
        """All of them, oldest first where nothing had to make room yet."""
        return {} if not len(self) else dict(self.buffer[:].items())  # type: ignore[union-attr]
