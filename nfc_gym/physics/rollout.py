"""Batched multiple-shooting roll-outs on `mujoco.batch`, with effects acting through their hooks at every physics step.

Rows of the batch are pairs (parameter vector, segment), parameter vectors slowest. Derived quantities that effects read
are one substep behind the state, exactly as they are in an `MjData` between two calls of `mj_step`, so that a wrapper
around a single environment and this roll-out agree bit for bit.
"""

import copy
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.acting import Acting
from nfc_gym.physics.activations import Activations, delayed, fill_delays, longest_delay
from nfc_gym.physics.effects.base import Effect, overrides
from nfc_gym.physics.effects.conditions import Conditioned
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.parameters import ParameterSpace, resolve, write_field
from nfc_gym.physics.past import Past

Array = NDArray[np.float64]
_ROW_BYTES = 300_000_000  # recorded trajectories of one call; more parameter vectors are run in turns


@dataclass(frozen=True)
class Servo:
    """A firmware position loop: ctrl = supply * clip(gain (target - q) - damping v, -limit, limit)."""

    actuator: int
    qpos: int
    dof: int
    limit: float


@dataclass(frozen=True)
class Segments:
    """S stretches of logs, laid on a uniform grid of physics steps; H steps of history come before the start.

    Attributes:
      dt: physics step, s.
      history: H.
      qpos, qvel: (S, nq), (S, nv) measured start states.
      ctrl: (S, H + K, nu) commands, or targets where a firmware servo computes the command.
      exogenous: name -> (S, H + K).
      known: (field, object names) -> (S, H + K) model fields that the log itself gives.
      servo: per `Servo`, its gain, supply and damping, (S, H + K) each.
      settle: steps for which the first command is held before the start; velocities and hidden states are then kept,
        the positions go back to the measured ones. 0 starts at the measured velocities.
      condition: (S,) label of the condition that each segment was recorded in.
      past: what was measured before the starts. Without it, or with no history, joints with a memory begin at rest,
        and slow states of the drives settled at the history's first command.
    """

    dt: float
    history: int
    qpos: Array
    qvel: Array
    ctrl: Array
    exogenous: Mapping[str, Array] = field(default_factory=dict)
    known: Mapping[tuple[str, tuple[str, ...]], Array] = field(default_factory=dict)
    servo: Sequence[tuple[Servo, Mapping[str, Array]]] = ()
    settle: int = 0
    condition: NDArray[np.str_] | None = None
    past: Past | None = None

    def __len__(self) -> int:
        return len(self.qpos)

    @property
    def steps(self) -> int:
        """K, physics steps after the start."""
        return self.ctrl.shape[1] - self.history


@dataclass(frozen=True)
class Trajectory:
    """What was rolled out. P parameter vectors, S segments, times 0, dt, ..., K dt.

    Attributes:
      qpos, qvel: (P, S, K + 1, nq), (P, S, K + 1, nv).
      sensordata: (P, S, K + 1, nsensordata), each at its own time, or None where not asked for.
      stable: (P, S) False where MuJoCo warned or a value is not finite; such rows hold no meaning.
      touched: (P, S) whether bodies touched in any step.
    """

    qpos: Array
    qvel: Array
    sensordata: Array | None
    stable: NDArray[np.bool_]
    touched: NDArray[np.bool_]


class Plant:
    """A model, its psi, and the effects at work in it.

    Args:
      model: the nominal model; `model.opt.timestep` is the physics step.
      space: psi.
      effects: in the order in which their hooks run.
      nthread: threads of the batch; 0 takes every core.
    """

    def __init__(
        self, model: mujoco.MjModel, space: ParameterSpace, effects: Sequence[Effect] = (), nthread: int = 0
    ) -> None:
        self.model, self.space, self.effects, self.nthread = model, space, tuple(effects), nthread
        for effect in self.effects:
            effect.bind(model)

    def with_effects(self, effects: Sequence[Effect]) -> "Plant":
        """The same machine with other effects."""
        return Plant(self.model, self.space, effects, self.nthread)

    @property
    def size(self) -> int:
        """Length of a full parameter vector: psi, then each effect's parameters."""
        return len(self.space) + sum(len(e.params) for e in self.effects)

    def split(self, x: Array) -> tuple[Array, list[Array]]:
        """Full parameter vectors (..., size) -> psi (..., d) and theta of each effect (..., k)."""
        sizes = [len(self.space), *(len(e.params) for e in self.effects)]
        psi, *thetas = np.split(x, np.cumsum(sizes)[:-1], axis=-1)
        return psi, thetas

    @property
    def null(self) -> Array:
        """(size,) nominal psi and every effect at null."""
        return np.concatenate([self.space.nominal, *(e.null for e in self.effects)])

    def chart(self, x: Array) -> Array:
        """Full parameter vectors (..., size) -> the coordinates that a fit walks in (`Effect.chart`); psi stays."""
        psi, thetas = self.split(x)
        return np.concatenate([psi, *(e.chart(t) for e, t in zip(self.effects, thetas, strict=True))], -1)

    def unchart(self, coordinates: Array) -> Array:
        """The inverse of `chart`."""
        psi, parts = self.split(coordinates)
        return np.concatenate([psi, *(e.unchart(c) for e, c in zip(self.effects, parts, strict=True))], -1)

    def under(self, x: Array, labels: NDArray[np.str_] | None) -> "tuple[Plant, Array]":
        """The machine in the conditions of some segments: effects that differ between them have one value each.

        Args:
          x: (P, size) full parameter vectors.
          labels: (S,) conditions.

        Returns:
          This plant and x where no effect differs; else a plant of the effects inside, and x (P, S, size').
        """
        if x.ndim == 3 or not any(isinstance(e, Conditioned) for e in self.effects):
            return self, x
        if labels is None:
            raise InputError("these segments have no condition, and effects of the model differ between conditions")
        psi, thetas = self.split(x)
        parts = [np.broadcast_to(psi[:, None], (len(x), len(labels), psi.shape[-1]))]
        effects: list[Effect] = []
        for effect, theta in zip(self.effects, thetas, strict=True):
            if isinstance(effect, Conditioned):
                parts.append(theta[:, effect.columns[effect.index(labels)]])
                effects.append(effect.inner)
            else:
                parts.append(np.broadcast_to(theta[:, None], (len(x), len(labels), theta.shape[-1])))
                effects.append(effect)
        return self.with_effects(effects), np.concatenate(parts, -1)

    def write(self, fields: ModelFields, x: Array) -> None:
        """Psi and the effects' model edits into one model, x (size,), or a batch, x (nsim, size)."""
        psi, thetas = self.split(x)
        self.space.write(fields, psi)
        for effect, theta in zip(self.effects, thetas, strict=True):
            effect.model(fields, theta)

    def shoot(self, x: Array, segments: Segments, sensors: bool = False) -> Trajectory:
        """Roll every segment out under every parameter vector.

        Args:
          x: (P, size) or (P, S, size) full parameter vectors, the latter with values of its own for each segment.
          segments: starts, commands and signals.
          sensors: record `sensordata` too.
        """
        plant, x = self.under(x, segments.condition)
        if plant is not self:
            return plant.shoot(x, segments, sensors)
        width = self.model.nq + self.model.nv + (self.model.nsensordata if sensors else 0)
        turn = max(1, int(_ROW_BYTES / (8 * len(segments) * (segments.steps + 1) * width)))
        parts = [self._shoot(x[i : i + turn], segments, sensors) for i in range(0, len(x), turn)]
        if len(parts) == 1:
            return parts[0]
        return Trajectory(
            np.concatenate([p.qpos for p in parts]),
            np.concatenate([p.qvel for p in parts]),
            np.concatenate([p.sensordata for p in parts if p.sensordata is not None]) if sensors else None,
            np.concatenate([p.stable for p in parts]),
            np.concatenate([p.touched for p in parts]),
        )

    def _shoot(self, x: Array, segments: Segments, sensors: bool) -> Trajectory:
        count, size = len(x), len(segments)
        rows = np.broadcast_to(x[:, None] if x.ndim == 2 else x, (count, size, self.size)).reshape(
            count * size, self.size
        )
        with np.errstate(invalid="ignore", over="ignore"):  # laws see what comes apart too; it is marked unstable
            return _Run(self, rows, count, segments, sensors).roll()


class _Unsensed(Batch):
    """A batch that computes no sensors, and looks for no islands where a single tree can be but one.

    Of a wheeled robot's step the first cost a tenth and the second a twentieth; its motion is the same, to the bit.
    """

    def __init__(self, model: mujoco.MjModel, nsim: int, nthread: int) -> None:
        blind, flag = copy.copy(model), mujoco.mjtDisableBit
        blind.opt.disableflags |= int(flag.mjDSBL_SENSOR) | (int(flag.mjDSBL_ISLAND) if model.ntree < 2 else 0)
        super().__init__(blind, nsim, nthread)

    def bind(self, name: str) -> Array:
        """Raises `LookupError` for what a sensor would have read: it would be zero here."""
        if name == "sensordata":
            raise LookupError("a roll-out without sensors has no sensordata: effects read the state alone")
        return super().bind(name)


class _Run:
    """One batch from set-up to the last step: the rows, their hidden states, and the recordings."""

    def __init__(self, plant: Plant, rows: Array, count: int, segments: Segments, sensors: bool) -> None:
        self.plant, self.segments, self.sensors, self.count = plant, segments, sensors, count
        self.copies = np.tile(np.arange(len(segments)), count)
        model = plant.model
        self.activations = Activations(model, segments.dt)
        self.thetas = plant.split(rows)[1]
        self.batch = (Batch if sensors else _Unsensed)(model, len(rows), plant.nthread)
        self.fields = ModelFields(self.batch, model)
        self.varying = self._write_known()
        plant.write(self.fields, rows)
        self.fields.commit()
        q, v = self._tile(segments.qpos), self._tile(segments.qvel)
        for effect, theta in zip(plant.effects, self.thetas, strict=True):
            q, v = effect.unsense(q, v, theta)
        # Live views: asking the batch for them anew costs as much as stepping a small machine.
        self.qpos, self.qvel, self.ctrl, self.act = (self.batch.bind(n) for n in ("qpos", "qvel", "ctrl", "act"))
        self.qpos[...], self.qvel[...] = q, v
        self.acting = Acting(model, plant.effects, self.thetas, self.fields, self.batch, segments.dt)
        self.reads = {s for e in plant.effects for s in e.signals}
        if sensors:
            self.batch.bind("sensordata")

    def _tile(self, array: Array) -> Array:
        """(P S, ...) copies of a segment's values (S, ...) for every parameter vector."""
        return array[self.copies]

    def _write_known(self) -> list[tuple[Any, Array]]:
        """Constant known fields are written once; those that vary through a segment are returned."""
        varying = []
        for (name, of), values in self.segments.known.items():
            bound = resolve(self.plant.model, name, of)
            start = values[:, self.segments.history]
            write_field(self.fields, bound, self._tile(start))
            if (values[:, self.segments.history :] != start[:, None]).any():
                varying.append((bound, values))
        return varying

    def _command(self, k: int, exogenous: Mapping[str, Array]) -> Array:
        """Command of step k (negative in the history) after the effects on it."""
        ctrl = self._tile(self.segments.ctrl[:, self.segments.history + k])
        return self.acting.command(ctrl, exogenous)

    def _exogenous(self, k: int) -> dict[str, Array]:
        signals = self.segments.exogenous
        return {n: self._tile(signals[n][:, self.segments.history + k]) for n in self.reads & signals.keys()}

    def _serve(self, k: int, ctrl: Array, q: Array, v: Array) -> Array:
        """Firmware servos turn targets into commands."""
        if not self.segments.servo:
            return ctrl
        ctrl = ctrl.copy()
        at = self.segments.history + k
        for servo, terms in self.segments.servo:
            wish = self._tile(terms["gain"][:, at]) * (ctrl[:, servo.actuator] - q[:, servo.qpos])
            wish = wish - self._tile(terms["damping"][:, at]) * v[:, servo.dof]
            ctrl[:, servo.actuator] = self._tile(terms["supply"][:, at]) * np.clip(wish, -servo.limit, servo.limit)
        return ctrl

    def roll(self) -> Trajectory:
        """Step through all segments at once."""
        self._remember()
        if self.segments.settle:
            start = self.qpos.copy()
            for k in range(self.segments.settle):
                self._advance(0, first=k == 0)
            self.qpos[...] = start
            self.batch.qacc_warmstart[...] = 0
            self.acting.derived.clear()
        return self._in_turns() if self._watched() else self._at_once()

    def _watched(self) -> bool:
        """Whether something in Python must see the state, or write to the model, before every step."""
        return bool(self.acting.acts or self.segments.servo or self.varying)

    def _in_turns(self) -> Trajectory:
        """Step by step, with hooks in between."""
        model, batch, steps = self.plant.model, self.batch, self.segments.steps
        rows, contacts = batch.nsim, batch.bind("ncon")
        touched = np.zeros(rows, bool)
        qpos, qvel = np.empty((steps + 1, rows, model.nq)), np.empty((steps + 1, rows, model.nv))
        sensed = np.empty((steps + 1, rows, model.nsensordata)) if self.sensors else None
        for k in range(steps):
            qpos[k], qvel[k] = self.qpos, self.qvel
            self._advance(k, first=k == 0)
            touched |= contacts > 0
            if sensed is not None:
                sensed[k] = batch.sensordata
        qpos[steps], qvel[steps] = self.qpos, self.qvel
        if sensed is not None:
            batch.forward()
            sensed[steps] = batch.sensordata
        sensed = None if sensed is None else sensed.swapaxes(0, 1)
        return self._result(qpos.swapaxes(0, 1), qvel.swapaxes(0, 1), sensed, touched)

    def _at_once(self) -> Trajectory:
        """All steps in one call of the engine, which takes the commands of all: faster, and the same bits."""
        batch, steps = self.batch, self.segments.steps
        begin = {"qpos": self.qpos.copy(), "qvel": self.qvel.copy()}
        if self.acting.commanding:
            ctrl = np.empty((batch.nsim, steps, self.plant.model.nu))
            for k in range(steps):
                ctrl[:, k] = self._command(k, self._exogenous(k))
        else:
            ctrl = self._tile(self.segments.ctrl[:, self.segments.history :])
        self._settle(ctrl[:, 0])
        record = (*begin, "ncon", *(["sensordata"] if self.sensors else []))
        found = batch.rollout(steps, ctrl, record=record)
        q, v = (np.concatenate([first[:, None], found[name]], 1) for name, first in begin.items())
        sensed = None
        if self.sensors:  # after a step sensors read what they did before it
            batch.forward()
            sensed = np.concatenate([found["sensordata"], batch.sensordata[:, None]], 1)
        return self._result(q, v, sensed, found["ncon"].max(1) > 0)

    def _remember(self) -> None:
        """Lead the hidden states through what was commanded and measured before the starts."""
        segments, past, acting = self.segments, self.segments.past, self.acting
        if past is not None and segments.history and any(e.slow for e, _ in acting.commanding):
            lead, step = past.lead
            signals = self._exogenous(-segments.history)
            for k in range(lead.shape[1]):
                acting.command(self._tile(lead[:, k]), signals, step)
            if lead.shape[1]:  # a log may begin no sooner than the history does
                acting.settle_quick()
        model = self.plant.model
        tracking = past is not None and bool(acting.tracking)
        longest = longest_delay(model)
        if not (acting.commanding or tracking or self.activations or longest):
            return  # nothing that remembers
        recent = deque[Array](maxlen=longest + 1)
        # Without an effect on them commands are the same for every parameter vector.
        alike = not (acting.commanding or tracking)
        act = np.zeros((len(segments), model.na)) if alike else self.act
        for k in range(-segments.history, 0):
            exogenous = self._exogenous(k)
            ctrl = segments.ctrl[:, segments.history + k] if alike else self._command(k, exogenous)
            recent.append(ctrl)
            self.activations.advance(delayed(model, recent, segments.dt), act, settle=k == -segments.history)
            if past is not None and tracking:
                q, v = map(self._tile, past.motion(k + segments.history))
                for effect, theta in zip(self.plant.effects, self.thetas, strict=True):
                    if overrides(effect, "unsense"):
                        q, v = effect.unsense(q, v, theta)
                acting.recall(q, v, self._serve(k, ctrl, q, v), exogenous)
        if alike and segments.history:
            self.act[...] = self._tile(act)
            recent = deque(map(self._tile, recent))
        if recent and longest:
            fill_delays(model, recent, self.batch.bind("history"))

    def _advance(self, k: int, first: bool) -> None:
        """One physics step under the command of step k."""
        batch, exogenous = self.batch, self._exogenous(k)
        for bound, values in self.varying:
            write_field(self.fields, bound, self._tile(values[:, self.segments.history + k]))
        self.ctrl[...] = self._serve(k, self._command(k, exogenous), self.qpos, self.qvel)
        if first:
            self._settle(self.ctrl)
        if self.acting.pushing:
            batch.qfrc_applied[...] = 0
            batch.xfrc_applied[...] = 0
        self.acting.push(self.ctrl, exogenous)
        batch.step()

    def _settle(self, ctrl: Array) -> None:
        """Without a history actuators' states begin settled at the first command (rows, nu)."""
        if self.segments.history == 0 and self.segments.settle == 0:
            self.activations.advance(ctrl, self.act, settle=True)
            if longest_delay(self.plant.model):
                fill_delays(self.plant.model, [ctrl], self.batch.bind("history"))

    def _result(self, qpos: Array, qvel: Array, sensed: Array | None, touched: NDArray[np.bool_]) -> Trajectory:
        """Of arrays (rows, K + 1, n), and (rows,)."""
        stable = (
            np.isfinite(qpos).all((1, 2)) & np.isfinite(qvel).all((1, 2)) & (self.batch.warning[..., 1].sum(-1) == 0)
        )
        lead = self.count, len(self.segments)

        def shape(a: Array) -> Array:
            return np.ascontiguousarray(a).reshape(*lead, *a.shape[1:])

        return Trajectory(
            shape(qpos), shape(qvel), None if sensed is None else shape(sensed),
            stable.reshape(lead), touched.reshape(lead),
        )  # fmt: skip
