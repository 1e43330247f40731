"""Losses as kernels that torch's compiler fuses: a GPU passes each number through memory fewer times."""

from collections.abc import Callable

import torch
from torch import Tensor

from nfc_gym.inference.data import Batch
from nfc_gym.inference.progress import Report

Losses = Callable[[Batch], dict[str, Tensor]]


class Compiled:
    """Losses of whole batches, compiled at the first; those of smaller batches, an epoch's last, are as they were.

    They draw the same random numbers as what they were made from. Where they cannot be compiled (no C compiler, a
    kernel that the machine does not take), that is said, and all are computed as they were.

    Args:
      losses: of a batch; its parameters' gradients are lost when it is compiled.
      size: of a whole batch.
      report: is told that it takes a while, or that it failed.
    """

    def __init__(self, losses: Losses, size: int, report: Report) -> None:
        self.plain, self.size, self.report = losses, size, report
        # The compiler's own random numbers would be others. Each shape is compiled for itself, and there is but one.
        self._fused: Losses | None = torch.compile(losses, dynamic=False, options={"fallback_random": True})
        self._tried = False

    def __call__(self, batch: Batch) -> dict[str, Tensor]:
        """As of what it was made from, to single precision."""
        if len(batch["psi"]) != self.size or self._fused is None:
            return self.plain(batch)
        if not self._tried:
            self._try(batch, self._fused)
        return self.plain(batch) if self._fused is None else self._fused(batch)

    def _try(self, batch: Batch, fused: Losses) -> None:
        """Compile forwards and backwards, which is when they fail if they do."""
        self._tried = True
        self.report.message("compiles the training step: half a minute on a GPU, minutes on a slow processor")
        device = batch["psi"].device
        try:
            with torch.random.fork_rng([device] if device.type == "cuda" else []):
                torch.stack(list(fused(batch).values())).sum().backward()
        except torch.OutOfMemoryError:
            raise
        except Exception as e:  # of whichever layer of the compiler
            self._fused = None
            self.report.message(f"goes on without: {(str(e).strip() or type(e).__name__).splitlines()[0]}")
