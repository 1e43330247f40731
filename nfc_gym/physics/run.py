"""One roll-out on `mujoco.batch`: rows of parameter vectors and segments, their hidden states, and what is recorded."""

import copy
from collections import deque
from collections.abc import Mapping
from functools import partial
from math import ceil
from typing import Any, Protocol
from weakref import WeakKeyDictionary

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from nfc_gym.physics.acting import Acting
from nfc_gym.physics.activations import Activations
from nfc_gym.physics.delays import delayed, fill_delays, longest_delay
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.sensors import true_state
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.parameters import resolve, write_field
from nfc_gym.physics.segments import Segments, Trajectory

Array = NDArray[np.float64]


class Rolled(Protocol):
    """What is rolled out: a model with effects, and what a parameter vector says of both (`rollout.Plant`)."""

    model: mujoco.MjModel
    effects: tuple[Effect, ...]
    nthread: int

    def split(self, x: Array) -> tuple[Array, list[Array]]:
        """Psi and each effect's parameters."""
        ...

    def write(self, fields: ModelFields, x: Array) -> None:
        """Parameters into the models of a batch."""
        ...


class _Unsensed(Batch):
    """A batch that computes no sensors, and looks for no islands where a single tree can be but one.

    Of a wheeled robot's step the first cost a tenth and the second a twentieth; its motion is the same, to the bit.
    """

    def __init__(self, model: mujoco.MjModel, nsim: int, nthread: int) -> None:
        super().__init__(model, nsim, nthread)
        flag = mujoco.mjtDisableBit
        # In the simulations: to copy the model for it costs several times what a batch does.
        self.expand("opt.disableflags")[...] |= int(flag.mjDSBL_SENSOR) | (
            int(flag.mjDSBL_ISLAND) if model.ntree < 2 else 0
        )

    def bind(self, name: str) -> Array:
        """Raises `LookupError` for what a sensor would have read: it would be zero here."""
        if name == "sensordata":
            raise LookupError("a roll-out without sensors has no sensordata: effects read the state alone")
        return super().bind(name)


_SHAPES: WeakKeyDictionary[mujoco.MjModel, mujoco.MjData] = WeakKeyDictionary()


def _batch(model: mujoco.MjModel, nsim: int, nthread: int, sensors: bool) -> Batch:
    """A batch that knows the shapes of its fields: each would make data of its own to find them, at twice its cost."""
    out = (Batch if sensors else _Unsensed)(model, nsim, nthread)
    if model not in _SHAPES:
        _SHAPES[model] = mujoco.MjData(copy.copy(model))  # of a copy: data hold their model, which would stay for ever
    out.__dict__["_data"] = _SHAPES[model]
    return out


class Run:
    """One batch from set-up to the last step: the rows, their hidden states, and the recordings."""

    def __init__(self, plant: Rolled, rows: Array, count: int, segments: Segments, sensors: bool) -> None:
        self.plant, self.segments, self.sensors, self.count = plant, segments, sensors, count
        self.copies = np.tile(np.arange(len(segments)), count)
        model = plant.model
        self.thetas = plant.split(rows)[1]
        self.batch = _batch(model, len(rows), plant.nthread, sensors)
        self.fields = ModelFields(self.batch, model)
        self.varying = self._write_known()
        plant.write(self.fields, rows)
        self.fields.commit()
        self.activations = Activations(model, segments.dt, self.fields.touched)
        a = None if segments.qacc is None else self._tile(segments.qacc)
        q, v = self._true(self._tile(segments.qpos), self._tile(segments.qvel), a)
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

    def _true(self, q: Array, v: Array, a: Array | None = None) -> tuple[Array, Array]:
        """Measured states (P S, nq), (P S, nv) without the faults of the sensors that they were read from."""
        return true_state(self.plant.effects, self.thetas, q, v, self.segments.channels, a)

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

    def _command(self, k: int, exogenous: Mapping[str, Array], q: Array, v: Array) -> Array:
        """Command of step k (negative in the history) after the effects on it; firmware servos see the state."""
        ctrl = self._tile(self.segments.ctrl[:, self.segments.history + k])
        serve = partial(self._serve, k, q=q, v=v) if self.segments.servo else None
        return self.acting.command(ctrl, exogenous, serve=serve)

    def _exogenous(self, k: int) -> dict[str, Array]:
        signals = self.segments.exogenous
        return {n: self._tile(signals[n][:, self.segments.history + k]) for n in self.reads & signals.keys()}

    def _serve(self, k: int, ctrl: Array, q: Array, v: Array) -> Array:
        """Firmware servos turn targets into commands."""
        ctrl, at = ctrl.copy(), self.segments.history + k
        for servo, terms in self.segments.servo:
            now = {name: self._tile(term[:, at]) for name, term in terms.items()}
            ctrl[:, servo.actuator] = servo.command(ctrl[:, servo.actuator], q, v, now)
        return ctrl

    def roll(self) -> Trajectory:
        """Step through all segments at once."""
        self._remember()
        self.activations.begin(self.batch, self.fields)
        if self.segments.settle:
            start = self.qpos.copy()
            for k in range(self.segments.settle):
                self._advance(0, first=k == 0)
            self.qpos[...] = start
            self.activations.begin(self.batch, self.fields)
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
                ctrl[:, k] = self._command(k, self._exogenous(k), self.qpos, self.qvel)  # no servo looks at them
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
        model = self.plant.model
        tracking = past is not None and bool(acting.tracking)
        longest = longest_delay(model)
        if not (acting.commanding or tracking or self.activations or longest):
            return  # nothing that remembers
        recent = deque[Array](maxlen=longest + 1)
        # Without an effect on them commands are the same for every parameter vector.
        alike = not (acting.commanding or tracking or segments.servo or self.activations.differ)
        act = np.zeros((len(segments), model.na)) if alike else self.act
        led = self._lead(act, alike)
        off = None
        if segments.off is not None and any(effect.off_before for effect, _ in acting.tracking):
            off = self._tile(segments.off[0]), self._tile(segments.off[1])
        for k in range(-segments.history, 0):
            exogenous, q, v = self._exogenous(k), self.qpos, self.qvel
            if past is not None and (tracking or segments.servo):
                q, v = self._true(*map(self._tile, past.motion(k + segments.history)))
            ctrl = segments.ctrl[:, segments.history + k] if alike else self._command(k, exogenous, q, v)
            recent.append(ctrl)
            self.activations.advance(
                delayed(model, recent, segments.dt, self.fields.touched), act, settle=k == -segments.history and not led
            )
            if tracking:
                acting.recall(q, v, ctrl, exogenous, off)
        if alike and segments.history:
            self.act[...] = self._tile(act)
            recent = deque(map(self._tile, recent))
        if recent and longest:
            fill_delays(model, recent, self.batch.bind("history"))

    def _lead(self, act: Array, alike: bool) -> bool:
        """Lead what remembers more than the history holds through the commands before it; whether there were any.

        Args:
          act: actuators' states, of the segments where commands are `alike` in all rows, else of the rows.
        """
        segments, past, acting = self.segments, self.segments.past, self.acting
        span = max([self.activations.span, *(e.span(theta) for e, theta in acting.commanding)])
        if past is None or not segments.history or span <= segments.history * segments.dt:
            return False
        lead, step = past.lead
        if not lead.shape[1]:  # a log may begin no sooner than the history does
            return False
        signals = {} if alike else self._exogenous(-segments.history)
        first = max(lead.shape[1] - ceil(min((span - segments.history * segments.dt) / step, lead.shape[1])), 0)
        for k in range(first, lead.shape[1]):
            ctrl = lead[:, k] if alike else acting.command(self._tile(lead[:, k]), signals, step)
            self.activations.advance(ctrl, act, settle=k == first, dt=step)
        acting.settle_quick()
        return True

    def _advance(self, k: int, first: bool) -> None:
        """One physics step under the command of step k."""
        batch, exogenous = self.batch, self._exogenous(k)
        for bound, values in self.varying:
            write_field(self.fields, bound, self._tile(values[:, self.segments.history + k]))
        self.ctrl[...] = self._command(k, exogenous, self.qpos, self.qvel)
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
