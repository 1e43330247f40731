"""A healthy case: a small machine, its model, a mapping that uses most of the grammar, and three short logs."""

import copy
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import yaml

BAGS = ("bag", "mcap") if find_spec("rosbags") else ()  # of ROS 1 and 2, where the extra `ros` is installed
FORMATS = ("npz", "csv", "parquet", "mat", *BAGS)
TOPIC = "/log"  # of bags: one message a row, with the columns by name as positions of joints

MODEL = """<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.01"/>
  <worldbody>
    <body name="bob">
      <joint name="hinge" axis="0 1 0" range="-2.5 2.5" limited="true" damping="0.1"/>
      <geom name="weight" size="0.02" pos="0 0 -0.1" mass="0.1" contype="0" conaffinity="0"/>
    </body>
    <body name="base" pos="0 1 1">
      <freejoint name="root"/>
      <geom name="hull" size="0.1" mass="1" contype="0" conaffinity="0"/>
      <site name="imu"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="hinge" kp="10" ctrlrange="-2.5 2.5"/></actuator>
  <sensor><gyro name="gyro" site="imu"/></sensor>
</mujoco>
"""

MAPPING: dict[str, Any] = {
    "version": 1,
    "model": "machine.xml",
    "parameters": [
        {"name": "mass", "field": "body_mass", "of": ["bob"], "unit": "kg", "nominal": 0.1, "low": 0.05, "high": 0.2},
        {"name": "damping", "field": "dof_damping", "of": ["hinge"], "unit": "N m s/rad", "low": 0.0, "high": 1.0},
    ],
    "logs": [{"path": "run_*.npz", "split": "auto", "group": "run_(\\d+)"}],
    "split": {"by": "log", "fit": 0.4, "select": 0.3, "verify": 0.3, "seed": 0},
    "time": {"column": "t", "unit": "s"},
    "controls": {"ctrl:servo": {"column": "goal", "unit": "rad", "hold": "zero"}},
    "channels": {
        "joint:hinge:pos": {"column": "q", "unit": "rad", "noise": 0.001},
        "joint:hinge:vel": {"column": "v", "unit": "rad/s", "noise": 0.01, "smooth": 3, "rate": 50},
        "body:base:quat": {"columns": ["qw", "qx", "qy", "qz"], "order": "wxyz", "noise": 0.01},
        "sensor:gyro": {"columns": ["gx", "gz"], "unit": "rad/s", "noise": 0.01, "axes": ["x", "z"], "mask": "ok"},
    },
    "exogenous": {"exo:supply": {"column": "volts", "unit": "V"}},
    "known": [{"field": "dof_armature", "of": ["hinge"], "columns": ["rotor"], "scale": 1.0, "unit": "kg m^2"}],
    "segments": {"length": 0.2, "history": 0.1, "horizons": [0.1, 0.2]},
    "effects": {"only": ["coulomb"], "exclude": []},
}


def table(seed: int, rows: int = 60) -> dict[str, np.ndarray]:
    """Columns of a log at 50 Hz: a swing, and a body that yaws to and fro."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows) / 50
    phase = rng.uniform(0, 6)
    q, v = np.sin(3 * t + phase), 3 * np.cos(3 * t + phase)
    yaw, rate = 0.8 * np.sin(2 * t), 1.6 * np.cos(2 * t)
    noisy = lambda x, sd: x + sd * rng.standard_normal(rows)  # noqa: E731
    return {
        "t": t, "goal": np.sin(3 * t + phase + 0.1), "q": noisy(q, 1e-3), "v": noisy(v, 1e-2),
        "qw": np.cos(yaw / 2), "qx": 0 * t, "qy": 0 * t, "qz": np.sin(yaw / 2),
        "gx": noisy(0 * t, 1e-2), "gz": noisy(rate, 1e-2), "ok": (t > 0.1).astype(float),
        "volts": noisy(24 + 0 * t, 0.1), "rotor": 0.01 + 0 * t,
    }  # fmt: skip


@dataclass
class Case:
    """What will be written to a folder.

    Attributes:
      mapping: data of the mapping file; a text where it is no longer data.
      model: text of machine.xml.
      logs: stem -> columns.
      suffix: of the logs' files.
      edits: file name -> what happens to its bytes once written.
      extra: further files.
    """

    mapping: Any
    model: str
    logs: dict[str, dict[str, np.ndarray]]
    suffix: str = "npz"
    edits: dict[str, Callable[[bytes], bytes]] = field(default_factory=dict)
    extra: dict[str, bytes] = field(default_factory=dict)

    def write(self, folder: Path) -> Path:
        """Write all files; returns the mapping's path."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "machine.xml").write_text(self.model, encoding="utf-8", errors="surrogatepass")
        mapping = in_bags(self.mapping) if self.suffix in BAGS else self.mapping
        text = mapping if isinstance(mapping, str) else yaml.safe_dump(mapping, sort_keys=False)
        (folder / "mapping.yaml").write_text(text.replace(".npz", f".{self.suffix}"), encoding="utf-8")
        for stem, columns in self.logs.items():
            save(folder / f"{stem}.{self.suffix}", columns)
        for name, content in self.extra.items():
            (folder / name).write_bytes(content)
        for name, edit in self.edits.items():
            (folder / name).write_bytes(edit((folder / name).read_bytes()))
        return folder / "mapping.yaml"


def in_bags(value: Any, column: bool = False) -> Any:
    """A mapping's data with the columns' names that the reader of bags gives; a text stays."""
    if isinstance(value, dict):
        return {k: in_bags(v, k in ("column", "columns", "mask")) for k, v in value.items()}
    if isinstance(value, list):
        return [in_bags(v, column) for v in value]
    if not (column and isinstance(value, str)):
        return value
    return f"{TOPIC}.time" if value == "t" else f"{TOPIC}.position[{value}]"


def save(path: Path, columns: dict[str, np.ndarray]) -> None:
    """Columns in the format that the suffix names, or as an npz of that name where the format cannot hold them."""
    try:
        _save(path, columns)
    except Exception:  # every format has its own ways to say so
        with open(path, "wb") as handle:
            np.savez(handle, **{k.replace("file", "f"): v for k, v in columns.items()})  # pyright: ignore[reportArgumentType]


def _save(path: Path, columns: dict[str, np.ndarray]) -> None:
    if path.suffix == ".npz":
        np.savez(path, **columns)  # pyright: ignore[reportArgumentType]
    elif path.suffix == ".mat":
        import scipy.io

        scipy.io.savemat(path, {k[:31]: v for k, v in columns.items() if k.isidentifier()})
    elif path.suffix[1:] in BAGS:
        _save_bag(path, columns)
    else:
        import pandas as pd

        frame = pd.DataFrame(
            {k: pd.Series(list(v) if np.ndim(v) > 1 else np.atleast_1d(v)) for k, v in columns.items()}
        )
        frame.to_csv(path, index=False) if path.suffix == ".csv" else frame.to_parquet(path)


def _save_bag(path: Path, columns: dict[str, np.ndarray]) -> None:
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if path.suffix == ".bag" else Stores.ROS2_HUMBLE)
    of, names = store.types, [k for k in columns if k != "t"]
    rows = np.stack([np.asarray(columns[k], float) for k in names], 1)
    with np.errstate(all="ignore"):  # what is no time of a bag ends in the next line
        stamps = [int(s) for s in np.round(1e9 * np.asarray(columns["t"], float))]
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made) / "bag"
        old = path.suffix == ".bag"
        writer = Writer1(path) if old else Writer2(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        with writer as bag:
            kind, rest = "sensor_msgs/msg/JointState", {"velocity": np.zeros(0), "effort": np.zeros(0)}
            connection = bag.add_connection(TOPIC, kind, typestore=store)
            for at, row in zip(stamps, rows, strict=True):
                stamp = of["builtin_interfaces/msg/Time"](sec=at // 10**9, nanosec=at % 10**9)
                count = {"seq": 0} if old else {}
                header = of["std_msgs/msg/Header"](stamp=stamp, frame_id="", **count)
                message = of[kind](header=header, name=names, position=row, **rest)
                content = store.serialize_ros1(message, kind) if old else store.serialize_cdr(message, kind)
                bag.write(connection, at, content)
        if not old:
            path.write_bytes(next(folder.glob("*.mcap")).read_bytes())


def healthy(suffix: str = "npz") -> Case:
    """A case in which nothing is wrong."""
    return Case(copy.deepcopy(MAPPING), MODEL, {f"run_{i}": table(i) for i in range(3)}, suffix)
