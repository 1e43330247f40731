"""Training on a GPU as CUDA graphs: a step's thousand small kernels are launched at once."""

import warnings
from collections.abc import Callable, Hashable

import torch

from nfc_gym.inference.data import Batch
from nfc_gym.inference.replay import Replayed

Work = Callable[[Batch], None]
_WARM = 3  # batches before a capture: libraries choose their kernels and take their memory in the first ones


class Graphs:
    """Calls work on batches; on a GPU it is captured once for each shape of a batch, and replayed from then on.

    Work changes tensors in place, which stay where they are, and gives nothing back. It draws from the device's own
    generator, which is seeded before each call: replayed or not, it draws the same. Its first batches of a shape are
    worked on as they come. Work that waits for the GPU on its way cannot be captured: it is called each time, as all
    work is on a processor.

    Args:
      device: of the batches and of all that the work changes.
      on: whether anything is captured.
    """

    def __init__(self, device: torch.device, on: bool = True) -> None:
        self.device, self.on = device, on and device.type == "cuda"
        self.waiting: set[str] = set()  # names of work that cannot be captured
        self._seen: dict[Hashable, int] = {}
        self._captured: dict[Hashable, Replayed] = {}

    def __call__(self, work: Work, batch: Batch) -> None:
        """Work on a batch that is on the device."""
        key = (work.__name__, *((name, t.shape) for name, t in batch.items()))
        if key in self._captured:
            self._captured[key](*batch.values())
        elif not self.on or work.__name__ in self.waiting:
            work(batch)
        elif (seen := self._seen.get(key, 0)) < _WARM - 1:
            self._seen[key] = seen + 1
            work(batch)
        elif seen == _WARM - 1:
            self._seen[key] = seen + 1
            if _waits(work, batch):
                self.waiting.add(work.__name__)
        elif (replayed := self._capture(work, batch)) is not None:
            self._captured[key] = replayed
            replayed(*batch.values())
        else:
            self.waiting.add(work.__name__)
            work(batch)

    def _capture(self, work: Work, batch: Batch) -> Replayed | None:
        """None where some library waits after all, which only the capture tells."""
        names = tuple(batch)

        def run(*tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
            work(dict(zip(names, tensors, strict=True)))
            return ()

        stream = torch.cuda.current_stream(self.device)
        generator = torch.cuda.default_generators[stream.device_index]
        state = generator.clone_state()
        try:
            with torch.cuda.stream(stream):  # which a capture that fails does not go back to
                return Replayed(run, *batch.values(), warm=0)
        except RuntimeError:
            generator.graphsafe_set_state(state)  # the old one waits for the capture's end for good
            return None


def _waits(work: Work, batch: Batch) -> bool:
    """Work on a batch, and whether that waited for the GPU."""
    before = torch.cuda.get_sync_debug_mode()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            work(batch)
        finally:
            torch.cuda.set_sync_debug_mode(before)
    return any("called a synchronizing" in str(one.message) for one in said)  # beside what is said of the mode itself
