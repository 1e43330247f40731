"""How a GPU is told what to do: whole updates and plans as CUDA graphs, their kernels fused by torch's compiler.

An update is 1400 kernels and a plan 1600, each of a few microseconds with the published network: told one by one, a GPU
waits most of the time for the next.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nfc_gym.inference.graphs import Graphs

Function = Callable[..., Any]


def _print(text: str) -> None:
    print(text, flush=True)


@dataclass(frozen=True)
class Speed:
    """What is done for it; the law is the same.

    Attributes:
      graphs: whether a GPU replays updates and plans as CUDA graphs.
      compiled: whether their parts are compiled first, which takes a minute or two.
      say: is told what could not be done, and that what can takes a while.
    """

    graphs: bool = True
    compiled: bool = False
    say: Callable[[str], Any] = _print

    def fused(self, plain: Function, learns: bool = False) -> Function:
        """A function that is compiled at its first call, or as it is where nothing is to be compiled."""
        return Fused(plain, self.say, learns) if self.compiled else plain

    def replayed(self, device: torch.device | str) -> Graphs:
        """Of work on a device; on a processor it is done as it comes."""
        return Graphs(torch.device(device), self.graphs)


class Fused:
    """A function of tensors, compiled at its first call; where that fails it is said, and it is as it was.

    It draws the same random numbers as what it was made from.

    Args:
      plain: tensors to tensors, alone or in tuples and dictionaries.
      say: is told.
      learns: whether what it gives is differentiated; then that is tried too.
    """

    def __init__(self, plain: Function, say: Callable[[str], Any], learns: bool) -> None:
        self.plain, self.say, self.learns = plain, say, learns
        # The compiler's own random numbers would be others. Each shape is compiled for itself, and there are few.
        self._fused: Function | None = torch.compile(plain, dynamic=False, options={"fallback_random": True})
        self._tried = False

    def __call__(self, *given: Tensor) -> Any:
        """As of what it was made from, to single precision."""
        if self._fused is not None and not self._tried:
            self._try(self._fused, given)
        return (self._fused or self.plain)(*given)

    def _try(self, fused: Function, given: tuple[Tensor, ...]) -> None:
        """Compile forwards and backwards, which is when they fail if they do; gradients are lost by it."""
        self._tried = True
        name, device = getattr(self.plain, "__name__", "a part"), given[0].device
        self.say(f"compiles {name.strip('_')}: half a minute on a GPU, minutes on a slow processor")
        try:
            with torch.random.fork_rng([device] if device.type == "cuda" else []):
                made = fused(*given)
                if self.learns:
                    torch.stack([t.sum() for t in _tensors(made) if t.requires_grad]).sum().backward()
        except torch.OutOfMemoryError:
            raise
        except Exception as e:  # of whichever layer of the compiler
            self._fused = None
            self.say(f"goes on without: {(str(e).strip() or type(e).__name__).splitlines()[0]}")


def _tensors(made: Any) -> list[Tensor]:
    if isinstance(made, Tensor):
        return [made]
    parts = made.values() if isinstance(made, dict) else made
    return [t for part in parts for t in _tensors(part)]
