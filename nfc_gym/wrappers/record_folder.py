"""A folder of logs in the measured loop's format: the model, the mapping, and a Parquet file an episode."""

import os
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError, MissingExtra
from nfc_gym.core.files import numbered, require_writable, write_whole
from nfc_gym.physics.names import names
from nfc_gym.wrappers.record_channels import columns, model_text, values

Array = NDArray[np.float64]
_NEEDED = ("pyarrow", "yaml")
_MODEL = "model.xml"
# Declared of what a simulation measures, which has no noise: fine enough that jumps are taken as they were recorded,
# and coarse enough that a fit finds its way from where an effect is missing. Of joints, and of free bodies.
_JOINT = {"rad": 1e-3, "m": 1e-4, "rad/s": 0.1, "m/s": 0.01}
_BODY = {"m": 3e-5, "m/s": 1e-3, "rad/s": 0.01}
_ATTITUDE = 1e-4  # rad
_SAMPLES = 8  # in a compared stretch, where control is slow: as many as 0.4 s at 20 Hz


def folder_of(path: Any) -> Path:
    """A folder's path; what names none raises `InputError`."""
    if not isinstance(path, str | os.PathLike) or not os.fspath(path) or isinstance(os.fspath(path), bytes):
        raise InputError(f"RecordLog: path is {path!r}, want the name of a folder")
    return Path(path)


class LogFolder:
    """Where the logs of one model go.

    Args:
      env: whose MJCF and psi are written.
      sim: its simulation.
      path: the folder; made here. Episodes are numbered after those that it already holds; several processes may write
        to it.
      model_file: the environment's MJCF, where it does not say itself.
      noise: standard deviations to declare, by kind of channel: `joint:pos`, `body:angvel`, ...; default those of a
        simulation.

    Raises:
      MissingExtra: Parquet or YAML cannot be written.
      InputError: the model's MJCF is not at hand, the folder holds logs of another model, or nothing can be written
        there.
    """

    def __init__(
        self, env: Any, sim: Any, path: str | os.PathLike[str], model_file: str | None,
        noise: Mapping[str, float] | None = None,
    ) -> None:  # fmt: skip
        missing = [name for name in _NEEDED if find_spec(name) is None]
        if missing:
            raise MissingExtra(f"RecordLog needs {', '.join(missing)}: pip install 'nfc_gym[measured]'")
        self.env, self.sim, self.folder, self.model_file = env, sim, folder_of(path), model_file
        self.columns, self.noise = columns(sim.nominal), dict(noise or {})
        kinds = sorted({_kind(c.name) for c in self.columns} - {"sensor"})
        if strange := self.noise.keys() - set(kinds):
            raise InputError(f"noise of {sorted(strange)[0]!r}: the channels are {', '.join(kinds)}")
        self.controls = [f"ctrl:{name}" for name in names(sim.nominal).actuators]
        if self.folder.exists() and not self.folder.is_dir():
            raise InputError(f"RecordLog: {self.folder} is a file; `path` is the folder that episodes are written to")
        require_writable(self.folder, "`path` of RecordLog")
        self.folder.mkdir(parents=True, exist_ok=True)
        self.count = self._there()
        self.text = ""
        self._heights: Array | None = None

    def describe(self) -> None:
        """The model, at the beginning of an episode: the ground may be another than before."""
        heights = _heights(self.env.unwrapped)
        if self.text and _equal(heights, self._heights):  # writing a heightfield as text takes a tenth of a second
            return
        text = model_text(self.env, self.sim.nominal, self.model_file)
        if self.count:
            self._require_model(text)
        if text != self.text:
            write_whole(self.folder / _MODEL, text)
        self.text, self._heights = text, heights

    def _require_model(self, text: str) -> None:
        file = self.folder / _MODEL
        if file.is_file() and file.read_text(encoding="utf-8") != text:
            raise InputError(
                f"RecordLog: {self.folder} holds logs of another model, or of the same on other ground: record into "
                'another folder, or hold the ground by reset(options={"terrain_id": ...})'
            )

    def _there(self) -> int:
        return len(list(self.folder.glob("episode_*.parquet")))

    def write(self, record: dict[str, Array]) -> None:
        """One episode: `time` (T,), and qpos, qvel, ctrl, sensordata (T, ...); then the mapping."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        table: dict[str, Any] = {"time": record["time"]}
        table |= {name: record["ctrl"][:, i] for i, name in enumerate(self.controls)}
        for column in self.columns:
            series = values(column, record)
            for sense in self.sim.senses.live():
                series = sense(column.name, series, self.sim.duration())
            wide = pa.FixedSizeListArray.from_arrays(np.ascontiguousarray(series).reshape(-1), column.size)
            table[column.name] = series[:, 0] if column.size == 1 else wide
        self._require_model(self.text)  # another process may have begun with its own at the same time
        with numbered(self.folder, "episode_{:04d}.parquet".format, self.count) as (number, part):
            pq.write_table(pa.table(table), part)
        self.count = number + 1
        self._map()

    def _map(self) -> None:
        import yaml

        interval = self.sim.duration()
        space = getattr(self.env.unwrapped, "psi_space", None)
        rows = [] if space is None else [_parameter(p, n) for p, n in zip(space.parameters, space.nominal, strict=True)]
        mapping = {
            "version": 1,
            "model": _MODEL,
            "parameters": rows,
            "logs": [{"path": "episode_*.parquet"}],
            # Fewer than three episodes cannot be dealt out whole to fitting, choosing and verifying.
            "split": {"by": "log" if self._there() >= 3 else "time"},
            "time": {"column": "time", "unit": "s"},
            "controls": {n: {"column": n, "unit": "1"} for n in self.controls},
            "channels": {c.name: _channel(c, self.noise) for c in self.columns},
            "segments": {"length": float(max(0.4, _SAMPLES * interval))},
        }
        write_whole(self.folder / "mapping.yaml", yaml.safe_dump(mapping, sort_keys=False, allow_unicode=True))


def _heights(base: Any) -> Array | None:
    """What an environment's MJCF may change by from episode to episode: its ground, the first of a pool's."""
    ground = base.maps[0] if getattr(base, "maps", ()) else getattr(base, "heightfield", None)
    return getattr(ground, "heights", None)


def _equal(a: Array | None, b: Array | None) -> bool:
    return a is b or (a is not None and b is not None and np.array_equal(a, b))


def _parameter(p: Any, nominal: float) -> dict[str, Any]:
    keys = ("name", "field", "unit", "low", "high", "anchored", "reason")
    # One value for all its objects, as psi has it.
    return {**{k: getattr(p, k) for k in keys}, "of": list(p.of), "nominal": float(nominal), "tied": True}


def _kind(channel: str) -> str:
    """`joint:pos` of `joint:left_knee:pos`; of a sensor `sensor`."""
    kind, *_, last = channel.split(":")
    return kind if kind == "sensor" else f"{kind}:{last}"


def _channel(column: Any, noise: Mapping[str, float]) -> dict[str, Any]:
    places = [column.name] if column.size == 1 else [f"{column.name}[{i}]" for i in range(column.size)]
    quaternion = column.name.endswith(":quat")
    told: dict[str, Any] = {"order": "wxyz"} if quaternion else {"unit": column.unit}
    kind = column.name.split(":")[0]
    if quaternion or kind in ("joint", "body"):
        clean = _ATTITUDE if quaternion else (_JOINT if kind == "joint" else _BODY)[column.unit]
        told["noise"] = noise.get(_kind(column.name), clean)
    return {"columns": places, **told}
