"""ROS recordings: rosbag2 folders (`.db3` or MCAP inside), single `.db3` and `.mcap` files, ROS 1 bags; by `rosbags`.

Columns are `<topic>.<field>.<sub>`: `/odom.twist.twist.linear.x`; arrays of numbers whose length never changes are
(T, k), so that `/joint_states.position[3]` is an entry; entries of arrays of messages are `/low.motor[2].q`. Where a
message names its entries (`name` of sensor_msgs/JointState), `/joint_states.position[knee]` is addressed by name, and
holds NaN where a message lacks it. Each frame of tf is a topic: `/tf[base_link].transform.translation.x`. Times and
durations inside messages are seconds. Topics whose messages exceed 64 KiB (pictures, clouds) are left out, as are text
and arrays longer than 64.

A sample's time is its header's stamp where every message of the topic has one, else when it was received. Message
definitions are the bag's own; a bag without any is read by those of ROS 2's common packages.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import InputError
from nfc_gym.measured.readers.registry import broken, needed, parsing
from nfc_gym.measured.readers.streams import Stream, Streams

LARGEST_MESSAGE = 1 << 16  # bytes
LONGEST_ARRAY = 64  # the 6 x 6 covariances of nav_msgs fit
_CHUNK = 4096  # messages that are held before they become columns
_NAMES = ("name", "names", "joint_names")
_TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_TF = "tf2_msgs/msg/TFMessage"
_TRANSFORM = "geometry_msgs/msg/TransformStamped"
_ADVICE = (
    "copy it again or leave it out of `logs`; what is left of a recording that was cut off, `mcap recover` (MCAP) or "
    "`ros2 bag reindex` (.db3) makes readable"
)
Columns = dict[str, NDArray[Any]]
Fields = Mapping[str, Sequence[tuple[str, tuple[Any, Any]]]]


def read_bag(path: Path) -> Streams:
    """All topics of a recording; a folder's files are one log.

    Raises:
      InputError: `rosbags` is not installed, or the recording is cut off, damaged, or holds no message that can be read.
    """
    highlevel = needed(path, "rosbags.highlevel", "ros")
    typesys = needed(path, "rosbags.typesys", "ros")
    common = typesys.get_typestore(typesys.Stores.LATEST)
    with parsing(path, _ADVICE), highlevel.AnyReader([path], default_typestore=common) as bag:
        types = _Types(bag.typestore)
        topics, left_out, count = _messages(bag, types)
        if count != bag.message_count:
            raise broken(path, f"{bag.message_count} messages are announced, {count} are there", _ADVICE)
    streams = []
    for name, topic in topics.items():
        stream, missing = topic.stream(name)
        streams.append(stream)
        left_out |= missing
    if not streams:
        why = "; ".join(f"{topic}: {reason}" for topic, reason in left_out.items()) or "it holds no message"
        raise InputError(f"{path}: no topic that can be read ({why})")
    return Streams(streams, left_out)


class _Types:
    """The fields of message types, and which of them are numbers, times, arrays."""

    def __init__(self, store: Any) -> None:
        self._store = store
        self._known: dict[str, list[tuple[str, str, Any]]] = {}

    def fields(self, msgtype: str) -> list[tuple[str, str, Any]]:
        """(name, kind, detail): kind is number, time, numbers, text, texts, message, messages."""
        if msgtype not in self._known:
            self._known[msgtype] = [self._field(*f) for f in self._store.get_msgdef(msgtype).fields]
        return self._known[msgtype]

    @staticmethod
    def _field(name: str, desc: tuple[Any, Any]) -> tuple[str, str, Any]:
        node, detail = desc
        many = node.name in ("ARRAY", "SEQUENCE")
        if many:
            node, detail = detail[0]
        if node.name == "BASE":
            kind = "text" if detail[0] in ("string", "wstring") else "number"
            return name, kind + "s" * many, None
        if detail in _TIMES:
            return name, "times" if many else "time", None
        return name, "message" + "s" * many, detail

    def stamp(self, msgtype: str) -> str | None:
        """Where the sender's stamp is in a message: `header.stamp` or `stamp`; None where it has none."""
        for name, kind, detail in self.fields(msgtype):
            if name == "header" and kind == "message" and detail == "std_msgs/msg/Header":
                return "header.stamp"
            if name == "stamp" and kind == "time":
                return "stamp"
        return None


def _messages(bag: Any, types: _Types) -> tuple[dict[str, "_Topic"], dict[str, str], int]:
    """Topics by name, what is left out and why, and how many messages there were in all."""
    topics: dict[str, _Topic] = {}
    refused: dict[str, str] = {}
    silent = {c.topic: "no message was recorded" for c in bag.connections}
    count = 0
    for connection, received, raw in bag.messages():
        count += 1
        name, msgtype = connection.topic, connection.msgtype
        silent.pop(name, None)
        if name in refused:
            continue
        if len(raw) > LARGEST_MESSAGE:
            refused[name] = f"its messages are larger than {LARGEST_MESSAGE >> 10} KiB"
            continue
        if msgtype not in bag.typestore.fielddefs:
            refused[name] = f"its type {msgtype} is not defined in the recording: record it again as MCAP"
            continue
        message = bag.deserialize(raw, msgtype)
        for topic, kind, one in _unpacked(name, msgtype, message):
            if topic not in topics:
                topics[topic] = _Topic(kind, types)
            topics[topic].add(received, one, kind)
    for name in refused:  # a topic whose first messages were small
        topics.pop(name, None)
    return topics, silent | refused, count


def _unpacked(topic: str, msgtype: str, message: Any) -> Iterator[tuple[str, str, Any]]:
    """A message as it is; of tf, each frame's transform as a topic of its own."""
    if msgtype != _TF:
        yield topic, msgtype, message
        return
    for transform in message.transforms:
        yield f"{topic}[{transform.child_frame_id}]", _TRANSFORM, transform


class _Missing:
    """What has no column, and why; and in which order the names of an array's entries first came."""

    def __init__(self) -> None:
        self.why: dict[str, str] = {}
        self.order: dict[str, tuple[str, ...]] = {}


class _Topic:
    """Messages of one topic, turned into columns a chunk at a time."""

    def __init__(self, msgtype: str, types: _Types) -> None:
        self.msgtype, self.types = msgtype, types
        stamp = types.stamp(msgtype)
        self._stamp = None if stamp is None else attrgetter(stamp)
        self._where = stamp
        self._pending: list[Any] = []
        self._chunks: list[tuple[Columns, int]] = []
        self._received: list[int] = []
        self._stamps: list[int] = []
        self._missing = _Missing()

    def add(self, received: int, message: Any, msgtype: str) -> None:
        """One message; another type than the topic's first is refused."""
        if msgtype != self.msgtype:
            raise InputError(f"a topic sends both {self.msgtype} and {msgtype}: record them apart")
        self._received.append(received)
        if self._stamp is not None:
            stamp = self._stamp(message)
            self._stamps.append(stamp.sec * 10**9 + stamp.nanosec)
        self._pending.append(message)
        if len(self._pending) >= _CHUNK:
            self._flush()

    def _flush(self) -> None:
        if self._pending:
            columns = dict(_columns(self._pending, self.msgtype, self.types, "", self._missing))
            self._chunks.append((columns, len(self._pending)))
            self._pending = []

    def stream(self, name: str) -> tuple[Stream, dict[str, str]]:
        """The topic's stream, and its columns that are left out."""
        self._flush()
        columns, lost = _joined(self._chunks)
        missing = {column: why for column, why in (lost | self._missing.why).items() if column not in columns}
        received = np.array(self._received, np.int64)
        stamps, clock = received, "receive time, as its messages have no stamp"
        if self._stamps and min(self._stamps) > 0:
            stamps, clock = np.array(self._stamps, np.int64), f"{self._where}"
        elif self._stamps:
            clock = f"receive time, as {self._where} is not always set"
        return Stream(name, stamps, received, clock, columns), {f"{name}.{c}": why for c, why in missing.items()}


def _columns(
    objects: list[Any], msgtype: str, types: _Types, prefix: str, missing: _Missing
) -> Iterator[tuple[str, NDArray[Any]]]:
    """Columns of a list of messages of one type, (T,) or (T, k); `missing` takes what has no column, and why."""
    fields = types.fields(msgtype)
    labels = next((f for f, kind, _ in fields if kind == "texts" and f in _NAMES), None)
    names = [tuple(n) for n in map(attrgetter(labels), objects)] if labels else None
    for field, kind, detail in fields:
        values, name = list(map(attrgetter(field), objects)), prefix + field
        if kind == "number":
            yield name, np.array(values)
        elif kind == "time":
            yield name, np.array([v.sec + v.nanosec * 1e-9 for v in values])
        elif kind == "numbers":
            yield from _numbers(name, values, names, missing)
        elif kind == "message":
            yield from _columns(values, detail, types, f"{name}.", missing)
        elif kind == "messages":
            lengths = {len(v) for v in values}
            if len(lengths) > 1 or max(lengths) > LONGEST_ARRAY:
                missing.why[name] = _unfit(lengths)
                continue
            for i in range(max(lengths)):
                yield from _columns([v[i] for v in values], detail, types, f"{name}[{i}].", missing)


def _numbers(
    name: str, values: list[Any], labels: list[tuple[str, ...]] | None, missing: _Missing
) -> Iterator[tuple[str, NDArray[Any]]]:
    """An array in each message: (T, k) where its length never changes, and a column for each name that it has."""
    lengths = {len(v) for v in values}
    fixed = len(lengths) == 1 and 0 < max(lengths) <= LONGEST_ARRAY
    steady = labels is None or set(labels) == {missing.order.setdefault(name, labels[0])}
    if fixed and steady:
        yield name, np.stack(values)
    elif max(lengths) > 0:
        missing.why[name] = _unfit(lengths) if steady else "the order of its names changes: address it by name"
    if labels is None or max(lengths) > LONGEST_ARRAY:
        return
    for label in dict.fromkeys(n for row in labels for n in row):
        rows = [
            float(v[row.index(label)]) if len(v) == len(row) and label in row else np.nan
            for v, row in zip(values, labels, strict=True)
        ]
        if np.isfinite(rows).any():
            yield f"{name}[{label}]", np.array(rows)


def _unfit(lengths: Iterable[int]) -> str:
    longest, shortest = max(lengths), min(lengths)
    if longest != shortest:
        return f"its length changes, from {shortest} to {longest}"
    return f"it is {longest} long, and arrays over {LONGEST_ARRAY} are left out"


def _joined(chunks: list[tuple[Columns, int]]) -> tuple[Columns, dict[str, str]]:
    """Chunks end to end; NaN where a chunk has no column of a name; (T, k) must have one k throughout."""
    joined: Columns = {}
    lost: dict[str, str] = {}
    for name in dict.fromkeys(n for columns, _ in chunks for n in columns):
        parts = [columns.get(name) for columns, _ in chunks]
        widths = {p.shape[1:] for p in parts if p is not None}
        if len(widths) > 1 or (widths != {()} and any(p is None for p in parts)):
            lost[name] = "its length changes"
            continue
        filled = [np.full(n, np.nan) if p is None else p for p, (_, n) in zip(parts, chunks, strict=True)]
        joined[name] = np.concatenate(filled)
    return joined, lost
