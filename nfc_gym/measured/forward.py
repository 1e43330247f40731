"""Forward problems: what sensors read at the measured states and commands."""

from collections.abc import Sequence
from itertools import pairwise

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS, Batch
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Log
from nfc_gym.measured.instant import InstantProblem, Track
from nfc_gym.measured.observe import Observer, observer
from nfc_gym.physics.activations import Activations
from nfc_gym.physics.effects.base import Context, Forces, overrides
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.past import trace
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
            self._turn(plant, x[some], tracks, [(u[some], a[some]) for u, a in commands])
            for some in self.turns(len(x), tracks)
        ]
        return [np.concatenate([p[i] for p in parts]) for i in range(len(tracks))]

    def _turn(
        self, plant: Plant, x: Array, tracks: Sequence[Track], commands: Sequence[tuple[Array, Array]]
    ) -> list[Array]:
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
        batch.ctrl[...] = np.concatenate([u for u, _ in commands], 1)[:, kept].reshape(len(rows), -1)
        batch.act[...] = np.concatenate([a for _, a in commands], 1)[:, kept].reshape(len(rows), -1)
        sensordata = batch.bind("sensordata")  # bound before the call that fills it
        exogenous = {
            k: np.tile(np.concatenate([t.exogenous[k] for t in tracks])[kept], count) for k in tracks[0].exogenous
        }
        thetas = plant.split(rows)[1]
        pushing = [(e, th) for e, th in zip(plant.effects, thetas, strict=True) if overrides(e, "force")]
        if pushing:
            filled = set()  # what the last call filled: a view that is bound later waits for the next one

            def derived(name: str) -> Array:
                values = batch.bind(name)
                if name not in filled:
                    batch.forward()
                    filled.update(batch._bound)
                return values

            ctx = Context(
                plant.model, tracks[0].dt, batch.qpos, batch.qvel, batch.ctrl, exogenous, derived, fields.__getitem__
            )
            out = Forces(np.zeros_like(batch.qfrc_applied), np.zeros_like(batch.xfrc_applied))
            ends, side_by_side = np.cumsum([0, *lengths]), samples * np.arange(count)
            order = [np.arange(a, b)[:, None] + side_by_side for a, b in pairwise(ends)]
            for effect, theta in pushing:
                ctx.memory = trace(effect, ctx, theta, order) if overrides(effect, "follow") else None
                effect.force(ctx, theta, out)
            batch.qfrc_applied[...], batch.xfrc_applied[...] = out.qfrc, out.xfrc
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


def delivered(plant: Plant, x: Array, tracks: Sequence[Track]) -> list[tuple[Array, Array]]:
    """What reaches the actuators along each track: commands after the effects on them, and activations.

    Returns:
      for each track, commands (P, T, nu) and activations (P, T, na).
    """
    commanding = [i for i, e in enumerate(plant.effects) if overrides(e, "action")]
    model, count, longest = plant.model, len(x), max(len(t.time) for t in tracks)
    pad = lambda a: np.concatenate([a, np.repeat(a[-1:], longest - len(a), 0)])  # noqa: E731
    ctrl = np.stack([pad(t.ctrl) for t in tracks])
    exogenous = {k: np.stack([pad(t.exogenous[k]) for t in tracks]) for k in tracks[0].exogenous}
    thetas = [np.repeat(th, len(tracks), 0).reshape(count, len(tracks), -1) for th in plant.split(x)[1]]
    out = np.broadcast_to(ctrl, (count, *ctrl.shape)).copy()
    act = np.zeros((*out.shape[:-1], model.na))
    if commanding or model.na:
        dt = tracks[0].dt
        activations = Activations(model, dt)
        start = out[:, :, 0].copy()
        memories = {i: plant.effects[i].state0(start.shape[:-1], start, thetas[i], dt) for i in commanding}
        state = np.zeros((*start.shape[:-1], model.na))
        for k in range(longest):
            u = out[:, :, k]
            signals = {n: np.broadcast_to(s[:, k], u.shape[:-1]) for n, s in exogenous.items()}
            for i in commanding:
                u, memories[i] = plant.effects[i].action(u, thetas[i], memories[i], signals, dt)
            out[:, :, k] = u
            activations.advance(u, state, settle=k == 0)
            act[:, :, k] = state
    return [(out[:, i, : len(t.time)], act[:, i, : len(t.time)]) for i, t in enumerate(tracks)]
