"""What is written down while a policy learns: episodes, scalars through TorchRL's loggers, a progress line."""

import logging
from collections import deque
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from tensordict import TensorDictBase
from torchrl.record import CSVLogger, TensorboardLogger
from torchrl.record.loggers import Logger

_RECENT = 200  # episodes that means are over


class Episodes:
    """Returns, lengths and successes of the episodes that end, from batches of steps (n, T).

    An episode is a success if its goal was reached in it at any time.
    """

    def __init__(self) -> None:
        self._sums: torch.Tensor | None = None
        self._first: torch.Tensor | None = None
        self._recent: deque[tuple[float, float, float]] = deque(maxlen=_RECENT)
        self.goals = False
        self.count = 0

    @torch.no_grad()
    def see(self, batch: TensorDictBase) -> None:
        """Steps in the order in which they were taken."""
        reward, done = batch["next", "reward"][..., 0], batch["next", "done"][..., 0]
        self.goals = ("next", "success") in batch.keys(True)
        reached = batch["next", "success"] if self.goals else torch.zeros_like(done)
        parts = torch.stack([reward, torch.ones_like(reward), reached.to(reward.dtype)]).cpu()
        done = done.cpu()
        sums = torch.zeros(3, len(done)) if self._sums is None else self._sums
        first = torch.full((len(done),), torch.nan) if self._first is None else self._first
        for t in range(done.shape[1]):
            sums = sums + parts[:, :, t]
            over = done[:, t]
            if over.any():
                self._recent.extend((r, n, float(s > 0)) for r, n, s in sums[:, over].T.tolist())
                self.count += int(over.sum())
                first = torch.where(over & first.isnan(), sums[0], first)
                sums = torch.where(over, 0.0, sums)
        self._sums, self._first = sums, first

    @property
    def first(self) -> float | None:
        """Mean return of each simulation's first episode; None before all have ended: what has is the short ones."""
        return None if self._first is None or self._first.isnan().any() else float(self._first.mean())

    def forget(self, rows: slice) -> None:
        """The running episodes of some simulations, which begin anew without having ended."""
        if self._sums is not None:
            self._sums[:, rows] = 0.0

    def means(self) -> dict[str, float]:
        """Over the last episodes; nothing before the first ends."""
        if not self._recent:
            return {}
        returns, lengths, reached = torch.tensor(list(self._recent)).mean(0).tolist()
        return {"return": returns, "length": lengths} | ({"success": reached} if self.goals else {})


class Record:
    """Scalars by step into CSV files, into TensorBoard where that is installed, and on one line of the terminal.

    Args:
      folder: of the files, made with the first values: what is refused before them leaves nothing. None writes none.
      console: None says nothing.
    """

    def __init__(self, folder: Path | None, console: Console | None) -> None:
        logging.getLogger("torchrl").setLevel(logging.WARNING)  # the size of each buffer is no news
        self.folder, self.console = folder, console

    @cached_property
    def _loggers(self) -> list[Logger]:
        if self.folder is None:
            return []
        kept: list[Logger] = [CSVLogger("csv", log_dir=str(self.folder))]
        if find_spec("tensorboard") is not None:
            kept.append(TensorboardLogger("tensorboard", log_dir=str(self.folder)))
        else:
            self.say("no TensorBoard here, the curves go into CSV files alone: pip install tensorboard")
        return kept

    def scalars(self, step: int, values: dict[str, float]) -> None:
        """Write values down.

        Args:
          step: at which they are, on the axis of the curves.
          values: by name; a name with `/` in it goes into a folder.
        """
        for logger in self._loggers:
            for name, value in values.items():
                logger.log_scalar(name, value, step=step)

    def line(self, text: str, last: bool = False) -> None:
        """A line that the next one replaces on a terminal."""
        if self.console is not None:
            end = "\r" if self.console.is_terminal and not last else "\n"
            self.console.print(text, end=end, highlight=False, markup=False, emoji=False, soft_wrap=True)

    def say(self, text: str) -> None:
        """A line that stays."""
        self.line(text, last=True)


def in_words(values: dict[str, Any]) -> str:
    """`return 123.4  success 0.85 ...`"""
    return "  ".join(f"{k} {v:.4g}" for k, v in values.items())
