"""Recordings that the tests write themselves: bags by `rosbags`, ULog byte by byte from its published format."""

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

NS = 10**9
START = 1_700_000_000 * NS  # a bag's stamps count from 1970


def typestore() -> Any:
    """Message types of ROS 2, and of a machine that has its own."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("float32 q\nfloat64 torque\n", "machine_msgs/msg/Motor"))
    low = "std_msgs/Header header\nMotor[2] motor\nfloat64[3] gyro\nfloat64[] spare\nbool on\nstring text\n"
    store.register(get_types_from_msg(low, "machine_msgs/msg/Low"))
    store.register(get_types_from_msg("std_msgs/Header header\nfloat64 data\n", "machine_msgs/msg/Stamped"))
    return store


class Messages:
    """Makes messages of a store's types."""

    def __init__(self, store: Any) -> None:
        self.store = store

    def __call__(self, msgtype: str, **fields: Any) -> Any:
        return self.store.types[msgtype](**fields)

    def stamp(self, ns: int) -> Any:
        return self("builtin_interfaces/msg/Time", sec=int(ns // NS), nanosec=int(ns % NS))

    def header(self, ns: int) -> Any:
        return self("std_msgs/msg/Header", stamp=self.stamp(ns), frame_id="world")

    def vector(self, x: float, y: float = 0.0, z: float = 0.0) -> Any:
        return self("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))

    def joints(self, ns: int, names: Sequence[str], position: Any, velocity: Any = ()) -> Any:
        rest = {"velocity": np.asarray(velocity, float), "effort": np.zeros(0)}
        header = self.header(ns)
        return self(
            "sensor_msgs/msg/JointState", header=header, name=list(names), position=np.asarray(position, float), **rest
        )

    def command(self, ns: int, value: float) -> Any:
        return self("machine_msgs/msg/Stamped", header=self.header(ns), data=float(value))

    def imu(self, ns: int, rate: Sequence[float]) -> Any:
        still = {f"{k}_covariance": np.zeros(9) for k in ("orientation", "angular_velocity", "linear_acceleration")}
        quat = self("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        return self(
            "sensor_msgs/msg/Imu",
            header=self.header(ns),
            orientation=quat,
            angular_velocity=self.vector(*rate),
            linear_acceleration=self.vector(0, 0, 9.81),
            **still,
        )

    def pose(self, ns: int, wxyz: Sequence[float]) -> Any:
        w, x, y, z = map(float, wxyz)
        pose = self(
            "geometry_msgs/msg/Pose",
            position=self("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0),
            orientation=self("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )
        return self("geometry_msgs/msg/PoseStamped", header=self.header(ns), pose=pose)


Topic = tuple[str, Sequence[tuple[int, Any]]]


def write_bag(path: Path, store: Any, topics: Mapping[str, Topic], kind: str = "mcap", only: bool = False) -> Path:
    """A bag of topic -> (type, [(received ns, message)]).

    Args:
      kind: `mcap` or `sqlite3` make a rosbag2 folder, `ros1` a ROS 1 bag.
      only: return the storage file in the folder instead of the folder.
    """
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    if kind == "ros1":
        path = path.with_suffix(".bag")
        writer, serialize = Writer1(path), store.serialize_ros1
    else:
        plugin = StoragePlugin[kind.upper()]
        writer, serialize = Writer2(path, version=9, storage_plugin=plugin), store.serialize_cdr
    with writer as bag:
        sent = []
        for topic, (msgtype, messages) in topics.items():
            connection = bag.add_connection(topic, msgtype, typestore=store)
            sent += [(received, connection, msgtype, message) for received, message in messages]
        for received, connection, msgtype, message in sorted(sent, key=lambda s: s[0]):
            bag.write(connection, received, serialize(message, msgtype))
    return next(p for p in path.iterdir() if p.suffix in (".db3", ".mcap")) if only else path


ULOG_MAGIC = b"ULog\x01\x12\x35\x01"


def ulog_message(kind: str, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), ord(kind)) + content


def write_ulog(path: Path, topics: Mapping[str, Any], parameters: Mapping[str, float] | None = None) -> Path:
    """A ULog file, after https://docs.px4.io/main/en/dev_log/ulog_file_format.html.

    Args:
      topics: `name` or `name[1]` -> {"timestamp": (N,) us, field: (N,) or (N, k)}; other fields are written as float.
    """
    out = [ULOG_MAGIC + struct.pack("<Q", 0)]
    out.append(ulog_message("B", bytes(40)))
    rows = []
    added = []
    formats: set[str] = set()
    for number, (topic, fields) in enumerate(topics.items()):
        name, _, instance = topic.removesuffix("]").partition("[")
        kinds = {k: "uint64_t" if k.startswith("timestamp") else "float" for k in fields}
        spelled = [f"{kinds[k]}[{v.shape[1]}] {k}" if np.ndim(v) == 2 else f"{kinds[k]} {k}" for k, v in fields.items()]
        if name not in formats:
            out.append(ulog_message("F", f"{name}:{';'.join(spelled)};".encode()))
            formats.add(name)
        added.append(ulog_message("A", struct.pack("<BH", int(instance or 0), number) + name.encode()))
        for i, stamp in enumerate(fields["timestamp"]):
            content = struct.pack("<H", number)
            for key, values in fields.items():
                kind = np.uint64 if kinds[key] == "uint64_t" else np.float32
                content += np.asarray(values[i], kind).tobytes()
            rows.append((int(stamp), ulog_message("D", content)))
    for key, value in (parameters or {}).items():
        spelled_key = f"float {key}".encode()
        out.append(ulog_message("P", bytes([len(spelled_key)]) + spelled_key + struct.pack("<f", value)))
    out += added + [row for _, row in sorted(rows, key=lambda r: r[0])]
    path.write_bytes(b"".join(out))
    return path
