"""Forward problems: what sensors read at the measured states and commands."""

from collections.abc import Sequence
from itertools import pairwise

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS, Batch
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Log
from nfc_gym.measured.delivered import Delivered, delivered
from nfc_gym.measured.instant import InstantProblem, Track
from nfc_gym.measured.observe import Observer, observer
from nfc_gym.physics.acting import Acting
from nfc_gym.physics.delays import fill_delays, longest_delay
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

    def describe(self, model: mujoco.MjModel) -> list[tuple[str, str, str, str]]:
        """One column a component; of an orientation, which is predicted here and not compared, four."""
        return [
            (o.group, o.unit, o.place, o.name) for o in self.observers for _ in range(4 if o.quaternion else o.size)
        ]

    def evaluate(self, plant: Plant, x: Array, tracks: Sequence[Track]) -> list[Array]:
        """See `InstantProblem`."""
        commands = delivered(plant, x, tracks)
        parts = [
            self._turn(plant, x[some], tracks, [c.of(some) for c in commands]) for some in self.turns(len(x), tracks)
        ]
        return [np.concatenate([p[i] for p in parts]) for i in range(len(tracks))]

    def _turn(self, plant: Plant, x: Array, tracks: Sequence[Track], commands: Sequence[Delivered]) -> list[Array]:
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
