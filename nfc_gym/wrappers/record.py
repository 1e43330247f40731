"""`RecordLog`: what an environment does, in the measured loop's log format.

A folder with `model.xml`, `mapping.yaml` and one Parquet file an episode, its columns the channel names: put it through
`nfc-gym check FOLDER/mapping.yaml` and `nfc-gym close-loop`.
"""

import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError, MissingExtra
from nfc_gym.core.files import replacing, write_whole
from nfc_gym.wrappers.base import EnvWrapper
from nfc_gym.wrappers.record_channels import columns, model_text, names, values
from nfc_gym.wrappers.simulation import SingleSimulation, simulation_of

Array = NDArray[np.float64]
_NEEDED = ("pyarrow", "yaml")
_SAMPLES = 8  # in a compared stretch, where control is slow: as many as 0.4 s at 20 Hz
_HELD = ("qpos", "qvel", "ctrl", "sensordata")


class LogFolder:
    """Where the logs of one model go.

    Args:
      env: whose MJCF and psi are written.
      sim: its simulation.
      path: the folder; made here. Episodes are numbered after those that it already holds.
      model_file: the environment's MJCF, where it does not say itself.

    Raises:
      MissingExtra: Parquet or YAML cannot be written.
      InputError: the model's MJCF is not at hand, or the folder holds logs of another model.
    """

    def __init__(self, env: Any, sim: Any, path: str | os.PathLike[str], model_file: str | None) -> None:
        missing = [name for name in _NEEDED if find_spec(name) is None]
        if missing:
            raise MissingExtra(f"RecordLog needs {', '.join(missing)}: pip install 'nfc_gym[measured]'")
        self.env, self.sim, self.folder, self.model_file = env, sim, Path(path), model_file
        self.columns = columns(sim.nominal)
        self.controls = [f"ctrl:{name}" for name in names(sim.nominal).actuators]
        self.folder.mkdir(parents=True, exist_ok=True)
        self.count = len(list(self.folder.glob("episode_*.parquet")))
        self.text = ""

    def describe(self) -> None:
        """The model and the mapping, at the beginning of an episode: the ground may be another than before."""
        text = model_text(self.env, self.sim.nominal, self.model_file)
        if text == self.text:
            return
        file = self.folder / "model.xml"
        if self.count and file.is_file() and file.read_text(encoding="utf-8") != text:
            raise InputError(
                f"RecordLog: {self.folder} holds logs of another model, or of the same on other ground: record into another "
                'folder, or hold the ground by reset(options={"terrain_id": ...})'
            )
        write_whole(file, text)
        self.text = text

    def write(self, record: dict[str, Array]) -> None:
        """One episode: `time` (T,), and qpos, qvel, ctrl, sensordata (T, ...); then the mapping."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        table: dict[str, Any] = {"time": record["time"]}
        table |= {name: record["ctrl"][:, i] for i, name in enumerate(self.controls)}
        for column in self.columns:
            series = values(column, record)
            for sense in self.sim.senses:
                series = sense(column.name, series, self.sim.duration())
            wide = pa.FixedSizeListArray.from_arrays(np.ascontiguousarray(series).reshape(-1), column.size)
            table[column.name] = series[:, 0] if column.size == 1 else wide
        with replacing(self.folder / f"episode_{self.count:04d}.parquet") as part:
            pq.write_table(pa.table(table), part)
        self.count += 1
        self._map()

    def _map(self) -> None:
        import yaml

        interval = self.sim.duration()
        space = getattr(self.env.unwrapped, "psi_space", None)
        rows = [] if space is None else [_parameter(p, n) for p, n in zip(space.parameters, space.nominal, strict=True)]
        mapping = {
            "version": 1,
            "model": "model.xml",
            "parameters": rows,
            "logs": [{"path": "episode_*.parquet"}],
            # Fewer than three episodes cannot be dealt out whole to fitting, choosing and verifying.
            "split": {"by": "log" if self.count >= 3 else "time"},
            "time": {"column": "time", "unit": "s"},
            "controls": {n: {"column": n, "unit": "1"} for n in self.controls},
            "channels": {c.name: _channel(c) for c in self.columns},
            "segments": {"length": float(max(0.4, _SAMPLES * interval))},
        }
        write_whole(self.folder / "mapping.yaml", yaml.safe_dump(mapping, sort_keys=False, allow_unicode=True))


def _parameter(p: Any, nominal: float) -> dict[str, Any]:
    keys = ("name", "field", "unit", "low", "high", "anchored", "reason")
    # One value for all its objects, as psi has it.
    return {**{k: getattr(p, k) for k in keys}, "of": list(p.of), "nominal": float(nominal), "tied": True}


def _channel(column: Any) -> dict[str, Any]:
    places = [column.name] if column.size == 1 else [f"{column.name}[{i}]" for i in range(column.size)]
    quaternion = {"order": "wxyz"} if column.name.endswith(":quat") else {"unit": column.unit}
    return {"columns": places, **quaternion}


class Tape:
    """The samples of one running episode: the state at each control step's start, and the command that followed it.

    A sensor that feels forces shows the command too, so its reading belongs to the first physics step under it: it is
    taken after that step, where MuJoCo has it for the state before.
    """

    def __init__(self) -> None:
        self.time: list[float] = []
        self.rows: dict[str, list[Array]] = {k: [] for k in _HELD}

    def state(self, time: float, qpos: Array, qvel: Array) -> None:
        """A sample's state; copies are taken."""
        self.time.append(time)
        self.rows["qpos"].append(qpos.copy())
        self.rows["qvel"].append(qvel.copy())

    def finished(self, ctrl: Array, sensordata: Array) -> dict[str, Array]:
        """The whole record, closed with the last command held and the sensors of the last state."""
        self.rows["ctrl"].append(ctrl.copy())
        self.rows["sensordata"].append(sensordata.copy())
        return {"time": np.array(self.time), **{k: np.array(v) for k, v in self.rows.items()}}


class RecordLog(EnvWrapper):
    """Records every episode of any MuJoCo environment.

    Args:
      env: the environment.
      path: a folder for `model.xml`, `mapping.yaml` and `episode_0000.parquet`, ...
      model_file: the environment's MJCF, where it says neither `fullpath` nor `mjcf`.

    One sample a control step: time, commands as the environment sends them (before effects act on them), positions and
    velocities of joints and free bodies, sensors (with the sensor effects of `ApplyEffects`). A file is there once its
    episode is over (its end, the next reset, or `close`), and whole; episodes without a step leave none.
    """

    def __init__(self, env: gym.Env, path: str | os.PathLike[str], model_file: str | os.PathLike[str] | None = None) -> None:
        super().__init__(env, path=path, model_file=model_file)
        self.sim: SingleSimulation = simulation_of(env, "RecordLog")
        self.log = LogFolder(env, self.sim, path, None if model_file is None else os.fspath(model_file))
        self.tape: Tape | None = None
        self._scratch: mujoco.MjData | None = None
        self._step = 0
        if self.sim.nominal.nsensordata:
            self.sim.attach("RecordLog", after=True)
            self.sim.on_control.append(self._count)
            self.sim.on_substep.append(self._feel)
            self.sim.on_after.append(self._feel)
        else:
            self.sim.attach("RecordLog")
        self.sim.on_control.append(self._command)

    def _command(self) -> None:
        if self.tape is not None:
            self.tape.rows["ctrl"].append(self.sim.commanded)

    def _count(self) -> None:
        self._step = 0

    def _feel(self) -> None:
        if self._step == 1 and self.tape is not None:
            self.tape.rows["sensordata"].append(self.sim.data.sensordata.copy())
        self._step += 1

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Write the running episode, if any, and begin another."""
        self.flush()
        result = self.env.reset(seed=seed, options=options)
        self.sim.begin_episode()
        self.log.describe()
        self.tape = Tape()
        self._sample()
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step and take a sample; the end of the episode writes it."""
        result = self.env.step(action)
        self._sample()
        if result[2] or result[3]:
            self.flush()
        return result

    def _sample(self) -> None:
        if self.tape is not None:
            data = self.sim.data
            self.tape.state(data.time, data.qpos, data.qvel)

    def flush(self) -> None:
        """Write the running episode and stop recording it."""
        tape, self.tape = self.tape, None
        if tape is None or len(tape.time) < 2:
            return
        if len(tape.rows["ctrl"]) != len(tape.time) - 1:
            raise InputError(
                f"RecordLog: {type(self.env.unwrapped).__name__} took {len(tape.rows['ctrl'])} control steps in "
                f"{len(tape.time) - 1} steps; it must simulate once a step"
            )
        self.log.write(tape.finished(tape.rows["ctrl"][-1], self._sensors()))

    def _sensors(self) -> Array:
        """Sensors of the present state under the last command, computed aside."""
        model = self.sim.model
        if not model.nsensordata:
            return np.zeros(0)
        if self._scratch is None:
            self._scratch = mujoco.MjData(model)
        mujoco.mj_copyData(self._scratch, model, self.sim.data)
        mujoco.mj_forward(model, self._scratch)
        return self._scratch.sensordata

    def close(self) -> None:
        """Write the running episode, and close."""
        self.flush()
        self.env.close()
