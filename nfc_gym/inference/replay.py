"""A network's passes over one window on a GPU, as CUDA graphs: hundreds of small kernels, launched at once."""

from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from nfc_gym.inference.heads.score import Score
from nfc_gym.inference.network import Encoded, Network
from nfc_gym.inference.random import seeded

Pass = Callable[..., tuple[Tensor, ...]]
_WARM = 3  # passes before a capture: libraries choose their kernels and take their memory in the first ones
_KEPT = 16  # graphs, each with memory of its own; the oldest gives way
_MOST = 4096  # draws: above that a GPU is busy with arithmetic and not with launches


@contextmanager
def tensor_cores() -> Iterator[None]:
    """Matrices of float32 are multiplied in TF32 inside, where a GPU can: a third faster for one window.

    Draws of a network with weights at random move by 1 to 4 thousandths of their spread (measured on an H200).
    """
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


class Replayed:
    """A function of tensors, captured once and replayed with new values of the same shapes.

    Random numbers go on from torch's generator of the device at each replay, as they would without a graph. The
    function must not copy from or to the processor.

    Args:
      function: tensors to a tuple of tensors, all on one CUDA device.
      arguments: the first values.
      warm: calls before the capture; 0 where the function has been called with such values.
    """

    def __init__(self, function: Pass, *arguments: Tensor, warm: int = _WARM) -> None:
        self.inputs = [a.clone() for a in arguments]
        self.graph = torch.cuda.CUDAGraph()
        with torch.cuda.device(arguments[0].device), seeded(0, arguments[0].device):
            side = torch.cuda.Stream()
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):
                for _ in range(warm):
                    function(*self.inputs)
            torch.cuda.current_stream().wait_stream(side)
            with torch.cuda.graph(self.graph):
                self.outputs = function(*self.inputs)

    def __call__(self, *arguments: Tensor) -> tuple[Tensor, ...]:
        """The function's values, in memory of their own."""
        for kept, new in zip(self.inputs, arguments, strict=True):
            kept.copy_(new)
        self.graph.replay()
        return tuple(o.clone() for o in self.outputs)


class Passes:
    """Encoding one window and drawing from what was kept of it, as the network does both.

    What comes a second time on a GPU, with the same shapes and number of draws, is captured and replayed from then on;
    there `tensor_cores` multiply, the first time too, so that all turns draw alike.
    Densities other than the score model, whose sampling asks the processor what to do next, and encoders that wait for
    the GPU run as they are.

    Args:
      network: its weights may change in place; once it is moved, make another.
    """

    def __init__(self, network: Network) -> None:
        self.network = network
        self._seen: set[Hashable] = set()
        self._captured: dict[Hashable, Replayed] = {}

    def encode(self, states: Tensor, actions: Tensor, elevation: Tensor | None) -> Encoded:
        """See `Network.encode`."""
        given = (states, actions) if elevation is None else (states, actions, elevation)

        def run(*x: Tensor) -> tuple[Tensor, ...]:
            return tuple(t for t in self.network.encode(*x) if t is not None)

        if given[0].is_cuda and self.network.encoder.waits:
            with tensor_cores():
                return Encoded(*run(*given))
        return Encoded(*self._replayed(("encode", len(given)), run, *given))

    def sample(self, n: int, given: Encoded, blocks: int, **how: Any) -> Tensor:
        """See `Network.sample`."""

        def run(*x: Tensor) -> tuple[Tensor, ...]:
            return (self.network.sample(n, Encoded(*x), blocks, **how),)

        seen = given.features, given.mean, given.facing
        if n > _MOST or not isinstance(self.network.density, Score):
            return run(*seen)[0]
        return self._replayed(("sample", n, blocks, *sorted(how.items())), run, *seen)[0]

    def _replayed(self, key: Hashable, run: Pass, *given: Tensor) -> tuple[Tensor, ...]:
        if not given[0].is_cuda:
            return run(*given)
        if key not in self._seen:
            self._seen.add(key)
            with tensor_cores():
                return run(*given)
        if key not in self._captured:
            if len(self._captured) == _KEPT:
                del self._captured[next(iter(self._captured))]
            with tensor_cores():
                self._captured[key] = Replayed(run, *given)
        return self._captured[key](*given)
