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

from collections.abc import Collection, Iterator
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from nfc_gym.core import InputError
from nfc_gym.measured.readers.registry import broken, needed, parsing
from nfc_gym.measured.readers.ros_columns import Columns, Missing, Types, columns, joined
from nfc_gym.measured.readers.streams import Stream, Streams

LARGEST_MESSAGE = 1 << 16  # bytes
_MCAP = b"\x89MCAP0\r\n\x01"  # magic and the header's opcode; its length follows, then the profile
_PROFILE_AT, _LONGEST_PROFILE = len(_MCAP) + 8, 64  # bytes
_ZSTD = b"\x28\xb5\x2f\xfd"  # magic; a message begins with its encoding
_CHUNK = 4096  # messages that are held before they become columns
_TF = "tf2_msgs/msg/TFMessage"
_TRANSFORM = "geometry_msgs/msg/TransformStamped"
_ADVICE = (
    "copy it again or leave it out of `logs`; what is left of a recording that was cut off, `mcap recover` (MCAP) or "
    "`ros2 bag reindex` (.db3) makes readable"
)


def read_bag(path: Path, names: Collection[str] | None = None) -> Streams:
    """All topics of a recording; a folder's files are one log.

    Args:
      path: the recording.
      names: the columns that are wanted; of topics that none of them belongs to only the first message is decoded.
        None is all columns.

    Raises:
      InputError: `rosbags` is not installed, or the recording is cut off, damaged, or holds no readable message.
    """
    highlevel = needed(path, "rosbags.highlevel", "ros")
    typesys = needed(path, "rosbags.typesys", "ros")
    common = typesys.get_typestore(typesys.Stores.LATEST)
    if path.suffix == ".mcap":
        _require_ros(path)
    with parsing(path, _ADVICE), highlevel.AnyReader([path], default_typestore=common) as bag:
        types = Types(bag.typestore)
        topics, left_out, count = _messages(bag, types, names)
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


def _require_ros(path: Path) -> None:
    """Refuse an MCAP file that says that it is of something else: its messages are JSON, Protobuf or the like."""
    with path.open("rb") as file:
        start = file.read(_PROFILE_AT + 4 + _LONGEST_PROFILE)
    size = int.from_bytes(start[_PROFILE_AT : _PROFILE_AT + 4], "little")
    profile = start[_PROFILE_AT + 4 : _PROFILE_AT + 4 + size]
    if start.startswith(_MCAP) and size <= _LONGEST_PROFILE and profile != b"ros2":
        name = profile.decode("utf-8", "replace") or "none"
        raise InputError(
            f"{path}: its profile is {name!r}, and messages of ros2 alone are read; save its topics as columns of CSV, "
            "Parquet or npz"
        )


def _messages(bag: Any, types: Types, names: Collection[str] | None) -> tuple[dict[str, "_Topic"], dict[str, str], int]:
    """Topics by name, what is left out and why, and how many messages there were in all."""
    wanted = {c.topic for c in bag.connections if names is None or any(_of(name, c.topic) for name in names)}
    topics: dict[str, _Topic] = {}
    refused: dict[str, str] = {}
    silent = {c.topic: "no message was recorded" for c in bag.connections}
    count = 0
    for connection, received, raw in bag.messages():
        count += 1
        name, msgtype = connection.topic, connection.msgtype
        if name in refused or (name not in silent and name not in wanted):
            continue
        silent.pop(name, None)
        if len(raw) > LARGEST_MESSAGE:
            refused[name] = f"its messages are larger than {LARGEST_MESSAGE >> 10} KiB"
            continue
        if raw[: len(_ZSTD)] == _ZSTD:
            refused[name] = "its messages are compressed: name the recording's folder, whose metadata.yaml says how"
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


def _of(column: str, topic: str) -> bool:
    return column.startswith((f"{topic}.", f"{topic}["))


def _unpacked(topic: str, msgtype: str, message: Any) -> Iterator[tuple[str, str, Any]]:
    """A message as it is; of tf, each frame's transform as a topic of its own."""
    if msgtype != _TF:
        yield topic, msgtype, message
        return
    for transform in message.transforms:
        yield f"{topic}[{transform.child_frame_id}]", _TRANSFORM, transform


class _Topic:
    """Messages of one topic, turned into columns a chunk at a time."""

    def __init__(self, msgtype: str, types: Types) -> None:
        self.msgtype, self.types = msgtype, types
        stamp = types.stamp(msgtype)
        self._stamp = None if stamp is None else attrgetter(stamp)
        self._where = stamp
        self._pending: list[Any] = []
        self._chunks: list[tuple[Columns, int]] = []
        self._received: list[int] = []
        self._stamps: list[int] = []
        self._missing = Missing()

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
            found = dict(columns(self._pending, self.msgtype, self.types, "", self._missing))
            self._chunks.append((found, len(self._pending)))
            self._pending = []

    def stream(self, name: str) -> tuple[Stream, dict[str, str]]:
        """The topic's stream, and its columns that are left out."""
        self._flush()
        found, lost = joined(self._chunks)
        missing = {column: why for column, why in (lost | self._missing.why).items() if column not in found}
        received = np.array(self._received, np.int64)
        stamps, clock = received, "receive time, as its messages have no stamp"
        if self._stamps and min(self._stamps) > 0:
            stamps, clock = np.array(self._stamps, np.int64), f"{self._where}"
        elif self._stamps:
            clock = f"receive time, as {self._where} is not always set"
        return Stream(name, stamps, received, clock, found), {f"{name}.{c}": why for c, why in missing.items()}
