"""Forward problems: what sensors read at the measured states and commands."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS, Batch
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Log
from nfc_gym.measured.instant import InstantProblem, Track
from nfc_gym.measured.observe import Observer, observer
from nfc_gym.physics.acting import Acting
from nfc_gym.physics.activations import Activations, delayed, fill_delays, longest_delay
from nfc_gym.physics.effects.base import overrides
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]


class ForwardProblem(InstantProblem):
    """Sensors at measured states and commands, against `sensor:<name>` channels."""

    def compared(self, model: mujoco.MjModel, log: Log) -> list[str]:
        """The sensor channels."""
        found = [c for c in log.channels if c.startswith("sensor:")]
        if not found:
            raise InputError("segments.mode forward compares sensors: map at least one channel sensor:<name>")
        self.observers: list[Observer] = [
            o for c in found if (o := observer(model, c, log.channels[c].axes)) is not None
        ]
        return found

    def describe(self, model: mujoco.MjModel) -> list[tuple[str, str, str]]:
        """One column a component."""
        return [(o.group, o.unit, o.place) for o in self.observers for _ in range(o.size)]

    def evaluate(self, plant: Plant, x: Array, tracks: Sequence[Track]) -> list[Array]:
        """See `InstantProblem`."""
        commands = delivered(plant, x, tracks)
        parts = [
            self._turn(plant, x[some], tracks, [c.of(some) for c in commands]) for some in self.turns(len(x), tracks)
        ]
        return [np.concatenate([p[i] for p in parts]) for i in range(len(tracks))]

    def _turn(self, plant: Plant, x: Array, tracks: Sequence[Track], commands: Sequence["Delivered"]) -> list[Array]:
        count = len(x)
        lengths = [len(t.time) for t in tracks]
        samples = sum(lengths)
        # What remembers must be led through every sample.
        whole = any(overrides(e, hook) for e in plant.effects for hook in ("follow", "sense"))
        every = [np.ones(len(t.time), bool) if whole or t.wanted is None else t.wanted for t in tracks]
        kept = np.flatnonzero(np.concatenate(every))
        batch = Batch(plant.model, count * len(kept), plant.nthread)
        fields = _written(batch, plant, x)
        rows = np.repeat(x, len(kept), 0)
        join = lambda name: np.tile(np.concatenate([getattr(t, name) for t in tracks])[kept], (count, 1))  # noqa: E731
        batch.qpos[...], batch.qvel[...] = join("qpos"), join("qvel")
        came = lambda name: np.concatenate([getattr(c, name) for c in commands], 1)[:, kept].reshape(len(rows), -1)  # noqa: E731
        batch.ctrl[...], batch.act[...] = came("ctrl"), came("act")
        if longest_delay(plant.model):  # a buffer that holds one command alone lets it through
            fill_delays(plant.model, [came("passed")], batch.bind("history"))
        sensordata = batch.bind("sensordata")  # bound before the call that fills it
        exogenous = {
            k: np.tile(np.concatenate([t.exogenous[k] for t in tracks])[kept], count) for k in tracks[0].exogenous
        }
        acting = Acting(plant.model, plant.effects, plant.split(rows)[1], fields, batch, tracks[0].dt)
        if acting.acts:
            ends, side_by_side = np.cumsum([0, *lengths]), samples * np.arange(count)
            acting.push_along(
                batch.ctrl, exogenous, [np.arange(a, b)[:, None] + side_by_side for a, b in pairwise(ends)]
            )
        batch.forward()
        sensed = np.zeros((count, samples, sensordata.shape[-1]))
        sensed[:, kept] = sensordata.reshape(count, len(kept), -1)
        return self._read(plant, x, sensed, lengths, tracks[0].dt)

    def _read(self, plant: Plant, x: Array, sensed: Array, lengths: Sequence[int], dt: float) -> list[Array]:
        thetas = plant.split(x)[1]
        out = []
        for part in np.split(sensed, np.cumsum(lengths)[:-1], axis=1):
            columns = []
            for o in self.observers:
                values = o.read(part)
                for effect, theta in zip(plant.effects, thetas, strict=True):
                    if overrides(effect, "sense"):
                        values = effect.sense(o.name, values, theta, dt)
                columns.append(o.pick(values))
            out.append(np.concatenate(columns, -1))
        return out


def _written(batch: Batch, plant: Plant, x: Array) -> ModelFields:
    """Fields of a batch, with the same number of rows in turn for each parameter vector (P, size).

    Each vector is written into one model, from which MuJoCo derives its constants, and not into every row.
    """
    few = Batch(plant.model, len(x), 1)
    fields = ModelFields(few, plant.model)
    plant.write(fields, x)
    fields.commit()
    for name in MODEL_FIELDS:
        values = few.expanded(name)
        if values is not None:
            batch.expand(name)[...] = np.repeat(values, batch.nsim // len(x), 0)
    return ModelFields(batch, plant.model)


@dataclass(frozen=True)
class Delivered:
    """What reaches the actuators at the samples of a track, for each of P parameter vectors.

    Attributes:
      ctrl: (P, T, nu) commands after the effects on them.
      passed: (P, T, nu) what the actuators' own delays let through of them.
      act: (P, T, na) activations when a sample's command comes, which they have not felt yet.
    """

    ctrl: Array
    passed: Array
    act: Array

    def of(self, some: slice) -> "Delivered":
        """The same for some of the parameter vectors."""
        return Delivered(self.ctrl[some], self.passed[some], self.act[some])


def delivered(plant: Plant, x: Array, tracks: Sequence[Track]) -> list[Delivered]:
    """What reaches the actuators along each track at parameter vectors (P, size).

    Commands are held from sample to sample; what remembers them goes on in steps of the physics in between.
    """
    commanding = [i for i, e in enumerate(plant.effects) if overrides(e, "action")]
    model, count, longest = plant.model, len(x), max(len(t.time) for t in tracks)
    pad = lambda a: np.concatenate([a, np.repeat(a[-1:], longest - len(a), 0)])  # noqa: E731
    held = np.stack([pad(t.held) for t in tracks])
    rows, dt = held.shape[2], tracks[0].dt
    exogenous = {k: np.stack([pad(t.exogenous[k]) for t in tracks]) for k in tracks[0].exogenous}
    thetas = [np.repeat(th, len(tracks), 0).reshape(count, len(tracks), -1) for th in plant.split(x)[1]]
    out = np.broadcast_to(held[:, :, 0], (count, *held[:, :, 0].shape)).copy()
    passed, act = out, np.zeros((*out.shape[:-1], model.na))
    late = longest_delay(model)
    if commanding or model.na or late:
        start = out[:, :, 0].copy()
        # Steps of the physics from one row of the log to the next.
        parts = max(1, round(dt / rows / model.opt.timestep))
        step = dt / (rows * parts)
        memories = {i: plant.effects[i].state0(start.shape[:-1], start, thetas[i], step) for i in commanding}
        if not late and all(m is None for m in memories.values()):
            parts, step = 1, dt / rows  # where activations get to under a command that is held is known at once
        passed = out.copy() if late else out
        activations, state = Activations(model, step), np.zeros((*start.shape[:-1], model.na))
        recent = deque[Array](maxlen=late + 1)
        for k in range(longest):
            signals = {n: np.broadcast_to(s[:, k], start.shape[:-1]) for n, s in exogenous.items()}
            for part in range(rows * parts):
                u = np.broadcast_to(held[:, k, part // parts], start.shape)
                for i in commanding:
                    u, memories[i] = plant.effects[i].action(u, thetas[i], memories[i], signals, step)
                recent.append(u)
                through = delayed(model, recent, step)
                if part == 0:
                    if k == 0:
                        activations.advance(through, state, settle=True)
                    out[:, :, k], passed[:, :, k], act[:, :, k] = u, through, state
                activations.advance(through, state)
    return [Delivered(*(a[:, i, : len(t.time)] for a in (out, passed, act))) for i, t in enumerate(tracks)]
