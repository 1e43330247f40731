"""`RecordLog`: what an environment does, in the measured loop's log format.

A folder with `model.xml`, `mapping.yaml` and one Parquet file an episode, its columns the channel names: put it through
`nfc-gym check FOLDER/mapping.yaml` and `nfc-gym close-loop`.
"""

import os
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.wrappers.base import EnvWrapper, VectorEnvWrapper
from nfc_gym.wrappers.batched import batch_simulation_of
from nfc_gym.wrappers.order import beneath, kind
from nfc_gym.wrappers.record_folder import LogFolder, folder_of
from nfc_gym.wrappers.record_tape import Tape
from nfc_gym.wrappers.simulation import simulation_of
from nfc_gym.wrappers.simulation_base import Simulation

Path = str | os.PathLike[str]


class _Recording:
    """What the wrapper and its twin share: tapes by row, written to the folder once their episodes are over."""

    sim: Simulation
    log: LogFolder
    tapes: dict[int, Tape]
    env: Any

    def _open(self, env: Any, arguments: dict[str, Any]) -> None:
        super()._open(env, arguments)  # type: ignore[misc]
        self.tapes = {}
        self._physics_step, self._undescribed = 0, False

    def _wire(self, path: Path, model_file: Path | None) -> None:
        sim = self.sim
        for inner in beneath(self.env):
            if isinstance(inner, _Recording) and inner.log.folder.resolve() == folder_of(path).resolve():
                name = kind(self)
                raise InputError(f"{name} around {name}: both record into {os.fspath(path)}; give each its own folder")
        self.log = LogFolder(self.env, sim, path, None if model_file is None else os.fspath(model_file))
        self.sensing = int(sim.nominal.nsensordata) > 0
        sim.attach("RecordLog", after=self.sensing, substeps=self.sensing)
        sim.on_control.add(self._command)
        if self.sensing:
            sim.bind("sensordata")
            sim.on_substep.add(self._feel)
            sim.on_after.add(self._feel)

    def _command(self) -> None:
        sim, self._physics_step = self.sim, 0
        if self._undescribed:
            self.log.describe()
            self._undescribed = False
        time: Any = sim.bind("time")
        for row, tape in self.tapes.items():
            at = (row,) if sim.shape else ()
            tape.command(time[at] if at else time, sim.qpos[at], sim.qvel[at], sim.commanded[at])

    def _feel(self) -> None:
        if self._physics_step == 1:
            readings = self.sim.bind("sensordata")
            for row, tape in self.tapes.items():
                tape.sense(readings[row] if self.sim.shape else readings)
        self._physics_step += 1

    def flush(self, rows: Any = None) -> None:
        """Write the running episodes, or those of some rows, and stop recording them; the next reset begins another."""
        for row in list(self.tapes) if rows is None else [int(r) for r in rows]:
            tape = self.tapes.pop(row, None)
            if tape is not None and len(tape) > 1:
                self.log.write(tape.record())

    def close(self, **kwargs: Any) -> None:
        """Write the running episodes, and close."""
        self.flush()
        self.env.close(**kwargs)


class RecordLog(_Recording, EnvWrapper):
    """Records every episode of any MuJoCo environment.

    Args:
      env: the environment.
      path: a folder for `model.xml`, `mapping.yaml` and `episode_0000.parquet`, ...
      model_file: the environment's MJCF, where it says neither `fullpath` nor `mjcf`.

    One sample a control step: time, commands as the environment sends them (before effects act on them), positions and
    velocities of joints and free bodies, sensors (with the sensor effects of `ApplyEffects`). A file is there once its
    episode is over (its end, the next reset, or `close`), and whole; episodes of less than two steps leave none.

    Environments of several processes, as of an `AsyncVectorEnv`, may record into one folder.

    A folder holds one `model.xml`, and the ground is part of it. An environment on rough ground draws a map of its pool
    at each reset, so that the second episode would need another model: make it with `terrain_pool=1`, or reset it with
    the same `options={"terrain_id": ...}` each time. Where a `Hallucinate` chooses the ground (delta_e), it is that of
    the episode's first action, and a folder holds the episodes that have chosen the same.

    Raises:
      InputError: no MuJoCo environment, its MJCF is not at hand, another recorder beneath writes to the folder; at a
        reset (at the first step, where that is what chooses the ground), the folder holds logs of another model or
        other ground.
      MissingExtra: Parquet or YAML cannot be written.
    """

    def __init__(self, env: gym.Env, path: Path, model_file: Path | None = None) -> None:
        super().__init__(env, path=path, model_file=model_file)
        self.sim = simulation_of(env, "RecordLog")
        self._wire(path, model_file)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Write the running episode, if any, and begin another."""
        running = self.tapes
        with self.refusable(lambda: setattr(self, "tapes", running), self.sim.kept()):
            self.tapes = {}  # steps that a reset makes are no episode's
            self.sim.begin_episode()
            result = self.env.reset(seed=seed, options=options)
        self.tapes = running
        self.flush()
        self._undescribed = self.sim.late_ground
        if not self._undescribed:
            self.log.describe()
        self.tapes[0] = Tape()
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step; the end of the episode writes it."""
        result = self.env.step(action)
        if result[2] or result[3]:
            self.flush()
        return result


class VectorRecordLog(_Recording, VectorEnvWrapper):
    """`RecordLog` around a vector environment on `mujoco.batch`; arguments as there.

    It writes a file for each episode of each simulation. Made for tens of simulations: samples are taken row by
    row. On rough ground, whose pool holds many maps, no one model is that of all logs: it is refused.
    """

    def __init__(self, env: VectorEnv, path: Path, model_file: Path | None = None) -> None:
        super().__init__(env, path=path, model_file=model_file)
        if len(getattr(env.unwrapped, "maps", ())) > 1:
            raise InputError("VectorRecordLog: each simulation stands on another map of the pool; use terrain_pool=1")
        self.sim = batch_simulation_of(env, "RecordLog")
        self.sim.on_reset.add(self._begin)
        self._wire(path, model_file)

    def _begin(self, ids: NDArray[np.intp]) -> None:
        self.flush(ids)
        for row in ids:
            self.tapes[int(row)] = Tape()

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Write the running episodes of the rows that are reset, and begin others."""
        result = self.env.reset(seed=seed, options=options)
        self.log.describe()
        return result

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step; the end of an episode writes it."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        done = np.flatnonzero(terminated | truncated)
        waiting = [row for row in done if row in self.tapes and len(self.tapes[int(row)])]
        self.flush(waiting)
        return observation, reward, terminated, truncated, info
