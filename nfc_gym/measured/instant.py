"""Problems without roll-outs: actuator forces that a measured motion needs; sensors at measured states and commands.

Both look at every sample at once. They carry less evidence than roll-outs, since accelerations come from differences;
they are what a machine offers that measures forces, or whose states are known while only a sensor is to be predicted.
"""

import copy
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Log
from nfc_gym.measured.observe import Observer, observer
from nfc_gym.measured.problem import Columns, Problem
from nfc_gym.measured.smoothing import moving_average
from nfc_gym.measured.states import States, channel_noise
from nfc_gym.physics.effects.base import Context, Forces, actuator_names, overrides
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.parameters import resolve, write_field
from nfc_gym.physics.rollout import Plant, advance_activations

Array = NDArray[np.float64]
_LOAD_PASSES = 3  # friction that depends on the actuator's load, and a load that includes the friction: iterations


@dataclass(frozen=True)
class Track:
    """One log thinned to every `stride`-th sample: what the model is evaluated at, and what it is compared with."""

    name: str
    time: Array
    dt: float
    qpos: Array
    qvel: Array
    qacc: Array
    ctrl: Array
    exogenous: dict[str, Array]
    known: dict[tuple[str, tuple[str, ...]], Array]
    measured: Array
    mask: NDArray[np.bool_]
    noise: Array


def track(model: mujoco.MjModel, log: Log, states: States, channels: Sequence[str], stride: int) -> Track:
    """Thin a log; measured columns of all channels are set side by side."""
    rows = slice(None, None, stride)
    ctrl = np.zeros((len(log), model.nu))
    for key, values in log.controls.items():
        ctrl[:, actuator_names(model).index(key.removeprefix("ctrl:"))] = values
    known = {}
    for key, values in log.known.items():
        name, _, of = key.rpartition(":")
        known[(name, tuple(of.split("+")) if of else ())] = values[rows]
    columns, masks, noise = [], [], []
    for name in channels:
        c = log.channels[name]
        values = c.values.reshape(len(log), -1)
        columns.append(values)
        masks.append(np.isfinite(values) & (np.ones(len(log), bool) if c.mask is None else c.mask)[:, None])
        noise += [channel_noise(log, name)] * values.shape[1]
    return Track(
        log.name, log.time[rows], log.interval * stride,
        states.qpos[rows], states.qvel[rows], states.qacc[rows], ctrl[rows],
        {k: v[rows] for k, v in log.exogenous.items()}, known,
        np.concatenate(columns, 1)[rows], np.concatenate(masks, 1)[rows], np.array(noise),
    )  # fmt: skip


class InstantProblem(Problem):
    """Blocks of consecutive samples; a subclass says what is predicted along a whole track."""

    def __init__(
        self, model: mujoco.MjModel, logs: Sequence[Log], states: Sequence[States], length: float, stride: int = 1
    ) -> None:
        self.channels = self.compared(model, logs[0])
        self.smooth = max(logs[0].channels[c].smooth for c in self.channels)
        self.stride = stride if self.smooth == 1 else min(stride, max(1, self.smooth // 3))
        self.tracks = [track(model, log, s, self.channels, self.stride) for log, s in zip(logs, states, strict=True)]
        self.names = tuple(log.name for log in logs)
        self._layout(model, length)

    @abstractmethod
    def compared(self, model: mujoco.MjModel, log: Log) -> list[str]:
        """Channels of the log that this problem predicts."""

    @abstractmethod
    def evaluate(self, plant: Plant, x: Array, tracks: Sequence[Track]) -> list[Array]:
        """Predictions (P, T, C) along each track for parameter vectors (P, size)."""

    @abstractmethod
    def describe(self, model: mujoco.MjModel) -> list[tuple[str, str, str]]:
        """(group, unit, place) of each of the C columns."""

    def _layout(self, model: mujoco.MjModel, length: float) -> None:
        """Cut every track into blocks; within a block smoothed samples are thinned to independent ones."""
        thin = max(1, self.smooth // (2 * self.stride))
        per = max(2, round(length / (self.tracks[0].dt * thin)))
        log_of, rows = [], []
        for i, t in enumerate(self.tracks):
            index = np.arange(0, len(t.time), thin)
            for b in range(len(index) // per):
                block = index[b * per : (b + 1) * per]
                if t.mask[block].any():
                    log_of.append(i)
                    rows.append(block)
        if not rows:
            raise InputError(
                f"no log is long enough for one block of {length:g} s with a valid sample: shorten segments.length"
            )
        self.log_of, self.rows = np.array(log_of), np.array(rows)
        self.mask = np.stack([self.tracks[i].mask[r].ravel() for i, r in zip(self.log_of, self.rows, strict=True)])
        self.time_of = np.array([self.tracks[i].time[r[0]] for i, r in zip(self.log_of, self.rows, strict=True)])
        what = self.describe(model) * per
        self.columns = Columns(
            tuple(w[0] for w in what), tuple(w[1] for w in what), np.zeros(len(what)), tuple(w[2] for w in what)
        )

    def smoothed(self, values: Array) -> Array:
        """Moving average (T, C) over the samples that remain of the declared width."""
        return moving_average(values, max(1, self.smooth // self.stride))

    def residual(self, plant: Plant, x: Array) -> Array:
        """See `Problem`."""
        needed = np.unique(self.log_of)
        predicted = self.evaluate(plant, x, [self.tracks[i] for i in needed])
        out = np.zeros((len(x), *self.mask.shape))
        for i, values in zip(needed, predicted, strict=True):
            t = self.tracks[i]
            where = np.flatnonzero(self.log_of == i)
            for p in range(len(x)):
                error = self.smoothed(np.where(np.isfinite(t.measured), t.measured, 0) - values[p])
                out[p, where] = error[self.rows[where]].reshape(len(where), -1)
        return np.where(self.mask, out, 0.0)

    def covariance(self, plant: Plant, x: Array) -> Array:
        """Sensor noise alone: what the differentiated motion adds is unknown and lands in the unexplained variance."""
        width = self.mask.shape[1]
        kernel = max(1, self.smooth // self.stride)
        noise = np.stack([np.tile(self.tracks[i].noise, width // len(self.tracks[i].noise)) for i in self.log_of])
        sigma = np.zeros((len(self), width, width))
        sigma[:, np.arange(width), np.arange(width)] = np.maximum(noise, 1e-9) ** 2 / kernel
        return sigma

    def take(self, index: NDArray[np.intp]) -> "InstantProblem":
        """See `Problem`."""
        out = copy.copy(self)
        out.log_of, out.rows, out.mask, out.time_of = (
            self.log_of[index],
            self.rows[index],
            self.mask[index],
            self.time_of[index],
        )
        return out

    def synthetic(self, plant: Plant, x: Array, rng: np.random.Generator) -> "InstantProblem":
        """See `Problem`."""
        out = copy.copy(self)
        predicted = self.evaluate(plant, x[None], self.tracks)
        out.tracks = [
            Track(**{**t.__dict__, "measured": p[0] + rng.normal(size=t.measured.shape) * t.noise})
            for t, p in zip(self.tracks, predicted, strict=True)
        ]
        return out


class InverseProblem(InstantProblem):
    """Actuator forces needed for the measured motion, against `force:<actuator>` channels."""

    def compared(self, model: mujoco.MjModel, log: Log) -> list[str]:
        """The force channels."""
        found = [c for c in log.channels if c.startswith("force:")]
        if not found:
            raise InputError(
                "segments.mode inverse compares actuator forces: map at least one channel force:<actuator>"
            )
        self.actuators = [actuator_names(model).index(c.removeprefix("force:")) for c in found]
        return found

    def describe(self, model: mujoco.MjModel) -> list[tuple[str, str, str]]:
        """One column an actuator."""
        hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
        kinds = [int(model.jnt_type[model.actuator_trnid[a, 0]]) for a in self.actuators]
        return [
            ("torque", "N m", f"actuator:{actuator_names(model)[a]}")
            if k == hinge
            else ("force", "N", f"actuator:{actuator_names(model)[a]}")
            for a, k in zip(self.actuators, kinds, strict=True)
        ]

    def evaluate(self, plant: Plant, x: Array, tracks: Sequence[Track]) -> list[Array]:
        """See `InstantProblem`."""
        return [np.stack([actuator_forces(plant, row, t)[:, self.actuators] for row in x]) for t in tracks]


def actuator_forces(plant: Plant, x: Array, t: Track) -> Array:
    """(T, nu) forces of joint actuators that the measured motion of a track needs at parameters x (size,).

    Generalised forces come from `mj_inverse`, less what force effects add; dry friction that depends on the actuator's
    own load is iterated to consistency. Each joint is taken to have one actuator.
    """
    model, data = copy.copy(plant.model), mujoco.MjData(plant.model)
    fields = ModelFields(model, plant.model)
    for (name, of), values in t.known.items():
        write_field(fields, resolve(model, name, of), values[0])
    plant.write(fields, x)
    fields.commit()
    thetas = plant.split(x)[1]
    base = model.dof_frictionloss.copy()
    motion = _Motion(model, data, t)
    rubbing = [(e, th) for e, th in zip(plant.effects, thetas, strict=True) if overrides(e, "friction")]
    ctx = Context(
        plant.model,
        t.dt,
        t.qpos,
        t.qvel,
        t.ctrl,
        t.exogenous,
        motion.data,
        lambda name: _tile(base if name == "dof_frictionloss" else getattr(model, name), len(t.time)),
    )
    force = None if rubbing else motion.inverse(None)
    for _ in range(_LOAD_PASSES if rubbing else 0):
        level = np.tile(base, (len(t.time), 1))
        for effect, theta in rubbing:
            dofs, more = effect.friction(ctx, np.broadcast_to(theta, (len(t.time), len(theta))))
            level[:, dofs] += more
        force = motion.inverse(level)
        if not motion.load_read:
            break
        motion.fields["qfrc_actuator"] = force
    assert force is not None
    pushing = [(e, th) for e, th in zip(plant.effects, thetas, strict=True) if overrides(e, "force")]
    if pushing:
        motion.fields["qfrc_actuator"] = force
        out = Forces(np.zeros((len(t.time), model.nv)), np.zeros((len(t.time), model.nbody, 6)))
        for effect, theta in pushing:
            effect.force(ctx, np.broadcast_to(theta, (len(t.time), len(theta))), out)
        force = force - out.qfrc - motion.carried(out.xfrc)
    dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]
    actuation = force[:, dofs] / model.actuator_gear[:, 0]
    for effect, theta in zip(plant.effects, thetas, strict=True):
        if overrides(effect, "demand"):
            actuation = effect.demand(actuation, theta, t.exogenous, t.dt)
    return actuation


def _tile(a: Array, rows: int) -> Array:
    return np.broadcast_to(a, (rows, *np.shape(a)))


class _Motion:
    """Inverse dynamics along a track, with the derived fields that effects may read."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, t: Track) -> None:
        self.model, self._data, self._track = model, data, t
        self.fields: dict[str, Array] = {}
        self.load_read = False  # whether a law asked for the actuators' own load, which then must be made consistent

    def inverse(self, friction: Array | None) -> Array:
        """(T, nv) generalised forces; `friction` (T, nv) overrides the dry friction sample by sample."""
        m, d, t = self.model, self._data, self._track
        out, bias, passive = (np.empty((len(t.time), m.nv)) for _ in range(3))
        qpos, qvel, qacc = d.qpos, d.qvel, d.qacc
        for k in range(len(t.time)):
            qpos[:], qvel[:], qacc[:] = t.qpos[k], t.qvel[k], t.qacc[k]
            if friction is not None:
                m.dof_frictionloss[:] = friction[k]
            mujoco.mj_inverse(m, d)
            out[k], bias[k], passive[k] = d.qfrc_inverse, d.qfrc_bias, d.qfrc_passive
        self.fields |= {"qfrc_bias": bias, "qfrc_passive": passive}
        return out

    def data(self, name: str) -> Array:
        """A derived field (T, ...) of positions and velocities, computed along the track when first asked for."""
        if name == "qfrc_actuator":
            self.load_read = True
            if name not in self.fields:
                self.fields[name] = self.inverse(None)
        if name not in self.fields:
            batch = self._placed()
            values = batch.bind(name)
            batch.forward(stage=int(mujoco.mjtStage.mjSTAGE_VEL))
            self.fields[name] = values.copy()
        return self.fields[name]

    def _placed(self) -> Batch:
        batch = Batch(self.model, len(self._track.time))
        batch.qpos[...], batch.qvel[...] = self._track.qpos, self._track.qvel
        return batch

    def carried(self, wrenches: Array) -> Array:
        """(T, nv) generalised forces of body wrenches (T, nbody, 6) at the centres of mass."""
        if not wrenches.any():
            return np.zeros((len(wrenches), self.model.nv))
        batch = self._placed()
        smooth, passive, bias, actuator = (batch.bind(f"qfrc_{n}") for n in ("smooth", "passive", "bias", "actuator"))
        batch.xfrc_applied[...] = wrenches
        batch.forward()
        return smooth - passive + bias - actuator  # MuJoCo's sum of forces, less everything but the wrenches


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
        turn = max(1, 200_000 // sum(len(t.time) for t in tracks))
        parts = [
            self._turn(plant, x[i : i + turn], tracks, [(u[i : i + turn], a[i : i + turn]) for u, a in commands])
            for i in range(0, len(x), turn)
        ]
        return [np.concatenate([p[i] for p in parts]) for i in range(len(tracks))]

    def _turn(
        self, plant: Plant, x: Array, tracks: Sequence[Track], commands: Sequence[tuple[Array, Array]]
    ) -> list[Array]:
        count = len(x)
        lengths = [len(t.time) for t in tracks]
        samples = sum(lengths)
        batch = Batch(plant.model, count * samples, plant.nthread)
        fields = ModelFields(batch, plant.model)
        rows = np.repeat(x, samples, 0)
        plant.write(fields, rows)
        fields.commit()
        join = lambda name: np.tile(np.concatenate([getattr(t, name) for t in tracks]), (count, 1))  # noqa: E731
        batch.qpos[...], batch.qvel[...] = join("qpos"), join("qvel")
        batch.ctrl[...] = np.concatenate([u for u, _ in commands], 1).reshape(count * samples, -1)
        batch.act[...] = np.concatenate([a for _, a in commands], 1).reshape(count * samples, -1)
        sensordata = batch.bind("sensordata")  # bound before the call that fills it
        batch.forward()
        exogenous = {k: np.tile(np.concatenate([t.exogenous[k] for t in tracks]), count) for k in tracks[0].exogenous}
        thetas = plant.split(rows)[1]
        pushing = [(e, th) for e, th in zip(plant.effects, thetas, strict=True) if overrides(e, "force")]
        if pushing:

            def derived(name: str) -> Array:
                fresh = name not in batch._bound
                values = batch.bind(name)
                if fresh:
                    batch.forward()
                return values

            ctx = Context(
                plant.model, tracks[0].dt, batch.qpos, batch.qvel, batch.ctrl, exogenous, derived, fields.__getitem__
            )
            out = Forces(np.zeros_like(batch.qfrc_applied), np.zeros_like(batch.xfrc_applied))
            for effect, theta in pushing:
                effect.force(ctx, theta, out)
            batch.qfrc_applied[...], batch.xfrc_applied[...] = out.qfrc, out.xfrc
            batch.forward()
        sensed = sensordata.reshape(count, samples, -1)
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
        start = out[:, :, 0].copy()
        memories = {i: plant.effects[i].state0(start.shape[:-1], start, thetas[i], dt) for i in commanding}
        state = np.zeros((*start.shape[:-1], model.na))
        for k in range(longest):
            u = out[:, :, k]
            signals = {n: np.broadcast_to(s[:, k], u.shape[:-1]) for n, s in exogenous.items()}
            for i in commanding:
                u, memories[i] = plant.effects[i].action(u, thetas[i], memories[i], signals, dt)
            out[:, :, k] = u
            advance_activations(model, u, state, dt, settle=k == 0)
            act[:, :, k] = state
    return [(out[:, i, : len(t.time)], act[:, i, : len(t.time)]) for i, t in enumerate(tracks)]
