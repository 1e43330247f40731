"""Simulations of one robot, in this process or in others: PyBullet uses one core each."""

import copy
import os
import subprocess
import sys
from collections.abc import Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import NamedTuple, Protocol

import mujoco
import numpy as np
from worlds.acting import overrides

from nfc_gym.measured.hidden import Array, Hidden
from nfc_gym.terrain import Heightfield

from .senses import Senses
from .simulation import STEP, Simulation

CONTROL = 0.02  # s


class Task(NamedTuple):
    """What a herd is made of.

    Attributes:
      model: the machine as it truly is.
      hidden: what changes its commands; each simulation gets a copy.
      count: simulations.
      wheels: see `Simulation`.
    """

    model: mujoco.MjModel
    hidden: Hidden
    count: int
    wheels: dict[str, float] | None


class State(NamedTuple):
    """Of k simulations after a control step: (k, nq), (k, nv), (k, nu), (k, nsensordata)."""

    qpos: Array
    qvel: Array
    force: Array
    sensors: Array


class Herd(Protocol):
    """What both kinds offer. A step is begun and ended apart, so that several herds go on at the same time."""

    def put(self, i: int, ground: Heightfield | None, qpos: Array, qvel: Array) -> None:
        """Begin an episode in simulation i; on another ground it is built anew."""
        ...

    def begin(self, ids: Sequence[int], ctrl: Array) -> None:
        """A control step of some, with commands (k, nu)."""
        ...

    def end(self) -> State:
        """What came of it."""
        ...

    def close(self) -> None:
        """Free everything."""
        ...


class Near:
    """Simulations of this process, one after another."""

    def __init__(self, task: Task) -> None:
        self.task, self.senses = task, Senses(task.model)
        self.sims: list[Simulation | None] = [None] * task.count
        self.grounds: list[Heightfield | None] = [None] * task.count
        self.hidden = [copy.deepcopy(task.hidden) for _ in range(task.count)]
        self.commands = overrides(task.hidden, "command")
        self.stepped = copy.copy(task.model)
        self.stepped.opt.timestep = STEP
        self._state: State | None = None

    def put(self, i: int, ground: Heightfield | None, qpos: Array, qvel: Array) -> None:
        """See `Herd`."""
        sim, before = self.sims[i], self.grounds[i]
        same = before is ground or (before is not None and ground is not None and _equal(before, ground))
        if sim is None or not same:
            if sim is not None:
                sim.close()
            sim = self.sims[i] = Simulation(self.task.model, ground, self.task.wheels)
            self.grounds[i] = ground
        sim.place(qpos, qvel)
        self.hidden[i].begin(self.stepped)

    def begin(self, ids: Sequence[int], ctrl: Array) -> None:
        """See `Herd`."""
        model, k = self.task.model, len(ids)
        out = State(*(np.zeros((k, size)) for size in (model.nq, model.nv, model.nu, model.nsensordata)))
        for row, i in enumerate(ids):
            sim = self.sims[i]
            assert sim is not None, "step before reset"
            for _ in range(round(CONTROL / STEP)):
                out.force[row] = sim.step(self.hidden[i].command(ctrl[row].copy()) if self.commands else ctrl[row])
            sim.read(out.qpos[row], out.qvel[row])
            self.senses.read(sim, out.sensors[row])
        self._state = out

    def end(self) -> State:
        """See `Herd`."""
        assert self._state is not None, "end before begin"
        return self._state

    def close(self) -> None:
        """See `Herd`."""
        for sim in self.sims:
            if sim is not None:
                sim.close()


def _equal(one: Heightfield, other: Heightfield) -> bool:
    return np.array_equal(one.heights, other.heights)


class Far:
    """Simulations of another process.

    It is none of `multiprocessing`'s: a fork would take this process's threads and graphics card for its own, and what
    is spawned imports the script that runs, with torch, before it begins.
    """

    def __init__(self, task: Task) -> None:
        self.pipe, theirs = Pipe()
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "bullet.worker", str(theirs.fileno())], pass_fds=[theirs.fileno()],
                env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}, stdout=subprocess.DEVNULL,
            )  # fmt: skip
        self.pipe.send(task)

    def put(self, i: int, ground: Heightfield | None, qpos: Array, qvel: Array) -> None:
        """See `Herd`."""
        self.pipe.send(("put", (i, ground, qpos.copy(), qvel.copy())))

    def begin(self, ids: Sequence[int], ctrl: Array) -> None:
        """See `Herd`."""
        self.pipe.send(("begin", (list(ids), ctrl.copy())))
        self.pipe.send(("end", ()))

    def end(self) -> State:
        """See `Herd`."""
        return self.pipe.recv()

    def close(self) -> None:
        """See `Herd`."""
        self.pipe.close()  # at which it ends
        self.process.wait()


def serve(pipe: Connection) -> None:
    """A worker's loop, until the other end is closed: a task comes first, and what `end` returns is sent back."""
    herd = Near(pipe.recv())
    while True:
        try:
            name, args = pipe.recv()
        except (EOFError, KeyboardInterrupt):
            herd.close()
            return
        found = getattr(herd, name)(*args)
        if name == "end":
            pipe.send(found)
