"""`Streams`: a table whose columns were sampled by several clocks, each at its own times."""

import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]


@dataclass(frozen=True)
class Stream:
    """What one topic sent.

    Attributes:
      name: the topic.
      stamps: (N,) ns, when each sample was taken, by the sender's own stamp where it has one.
      received: (N,) ns, when each sample was logged.
      clock: what `stamps` are, in words.
      columns: without the topic's name: (N,) or (N, k).
    """

    name: str
    stamps: Stamps
    received: Stamps
    clock: str
    columns: Mapping[str, NDArray[Any]]


def normal_name(name: str) -> str:
    """A column's name as it is compared: an accented letter is one character, whatever system wrote the file."""
    return unicodedata.normalize("NFC", name)


class Streams(dict[str, NDArray[Any]]):
    """Columns by name, and which stream each belongs to.

    The grammar of names: `<topic>.<field>.<sub>` with `[i]` for an entry of an array; besides its fields every topic
    has `<topic>.time` (s, by the sender's stamps where it has them) and `<topic>.received` (s, when it was logged).
    Both count from the file's first stamp of that kind. The one that a mapping names as its `time` makes that topic
    the base, to which the others are resampled: by their `time` or by their `received`, as the base's is.

    Args:
      streams: what the file holds.
      left_out: topic or column -> why it cannot be used.
      constants: columns that stand for the whole log.
    """

    def __init__(
        self,
        streams: Sequence[Stream],
        left_out: Mapping[str, str] | None = None,
        constants: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.streams, self.left_out = tuple(streams), dict(left_out or {})
        self._owners: dict[str, Stream] = {}
        self._clocks: dict[str, tuple[Stream, Array]] = {}
        self._zero = {
            kind: min((int(getattr(s, kind)[0]) for s in streams if len(s.stamps)), default=0)
            for kind in ("stamps", "received")
        }
        for stream in streams:
            for column, values in stream.columns.items():
                name = normal_name(f"{stream.name}.{column}")
                self[name], self._owners[name] = values, stream
            for kind, label in (("stamps", "time"), ("received", "received")):
                name = f"{stream.name}.{label}"
                seconds = self.seconds(stream, kind)
                if name in self:
                    self.left_out[name] = "a field of that name gives way to the topic's own time"
                self._clocks[name] = stream, seconds
                self[name], self._owners[name] = seconds, stream
        for name, value in (constants or {}).items():
            self[name] = np.asarray(value)

    def seconds(self, stream: Stream, kind: str) -> Array:
        """(N,) s of a stream's `stamps` or `received`; the differences are exact to the nanosecond."""
        return (getattr(stream, kind) - self._zero[kind]) * 1e-9

    def clock(self, name: str) -> tuple[Stream, str] | None:
        """The stream whose `time` or `received` column is called `name`, and which of the two it is."""
        if name not in self._clocks:
            return None
        return self._clocks[name][0], "received" if name.endswith(".received") else "stamps"

    def owner(self, name: str) -> Stream | None:
        """The stream that a column, or an entry `name[i]` of one, belongs to; None for constants and unknown names."""
        if name in self._owners or not name.endswith("]"):
            return self._owners.get(name)
        return self._owners.get(name[: name.rindex("[")])
