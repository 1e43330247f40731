"""Experiments nobody made yet: commands, the motion that models expect of them, and the data that it would give.

The motion of a machine that stands or rolls by itself is rolled out from where a log begins. One that only a controller
keeps upright would fall: there the commands are a feed-forward, added to what a recorded log's controller did, and are
judged segment by segment from the recorded states.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Log
from nfc_gym.measured.bench import Bench
from nfc_gym.measured.envelope import Envelope, envelope
from nfc_gym.measured.motions import patterns
from nfc_gym.measured.room import Room, let_go, room
from nfc_gym.measured.segments import commanded, servos
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.states import States, channel_noise
from nfc_gym.measured.steps import interpolate
from nfc_gym.physics.effects.generic import TIME
from nfc_gym.physics.effects.lookup import actuator_names
from nfc_gym.physics.rollout import Plant
from nfc_gym.physics.segments import Segments, Trajectory

Array = NDArray[np.float64]


class Stage:
    """Where proposed commands are tried.

    Args:
      bench: the mapping, made ready.
      plant, x: the model whose motion is expected, (size,).
      logs: what was recorded.
      seconds: length of the proposal.

    Attributes:
      room: what may be commanded; at rest the first command of `start`, or where that drives the machine away, no
        force and no speed.
      open_loop: False where neither keeps the machine within what was seen.
      start: the log whose first state a proposal starts from.
      patterns: sets of controls to be moved together, (m, nu) each.

    Raises:
      InputError: nothing can be proposed, and why.
    """

    def __init__(self, bench: Bench, plant: Plant, x: Array, logs: Sequence[Log], seconds: float) -> None:
        self.bench, self.plant, self.x = bench, plant, x
        speeds = [float(np.linalg.norm(bench.states[log.name].qvel[0])) for log in logs]
        self.start = logs[int(np.argmin(speeds))]
        self.interval = self.start.interval
        self.time: Array = np.arange(round(seconds / self.interval) + 1, dtype=np.float64) * self.interval
        self.room: Room = room(bench, logs, self.start)
        self.envelope: Envelope = envelope(plant.model, [bench.states[log.name] for log in logs])
        moved = [np.stack([log.controls[n] for n in self.room.names], 1) for log in logs]
        self.patterns = patterns(np.concatenate(moved) / np.maximum(self.room.high - self.room.low, 1e-12))
        resting = next((r for r in (self.room, let_go(bench, self.room)) if self._stays(r)), None)
        self.open_loop = resting is not None
        self.room = resting or self.room
        self.allowed = np.zeros(0)
        self.recorded = [] if self.open_loop else _stretch(bench, logs, seconds)
        if not self.open_loop:
            self._require_stands()

    def _stays(self, room: Room) -> bool:
        """Whether its resting command alone keeps the machine within what was seen."""
        idle = np.zeros((1, len(self.time), len(room.names)))
        return bool(self.motion(room.commands(idle), [(self.plant, self.x)])[1][0] <= 0)

    def _require_stands(self) -> None:
        """Note how far recorded motion itself oversteps when it is followed segment by segment.

        Raises:
          InputError: it cannot be followed at all.
        """
        problem = self._added(np.zeros((1, len(self.time), len(self.room.names))))
        t = self.plant.shoot(self.x[None], problem.segments)
        if not t.stable.any():
            raise InputError(
                "nothing can be proposed: the simulated machine is unstable, under its resting command and from every "
                "recorded state that was tried; check segments.timestep, gains and units"
            )
        over = self.envelope.overstep(t.qpos[0], t.qvel[0], moving=False)
        self.allowed = np.where(t.stable[0], over, np.inf)

    def commands(self, w: Array) -> Array:
        """What is written out (..., nu): commands, or additions to a controller's where the loop must stay closed."""
        return self.room.commands(w) if self.open_loop else self.room.additions(w)

    def motion(self, commands: Array, models: Sequence[tuple[Plant, Array]]) -> tuple[list[Trajectory], Array]:
        """Each model's motion under commands (N, T, nu), and by how much the worst of them oversteps, (N,)."""
        segments = self._lay(commands)
        found = [plant.shoot(x[None], segments) for plant, x in models]
        over = [self.envelope.overstep(t.qpos[0], t.qvel[0]) for t in found]
        unstable = np.any([~t.stable[0] for t in found], axis=0)
        return found, np.where(unstable, 1e3, np.max(over, axis=0))

    def _lay(self, commands: Array) -> Segments:
        """Commands on the grid of physics steps, from the start log's first state; all other inputs held."""
        model, log, states = self.plant.model, self.start, self.bench.states[self.start.name]
        count, dt = len(commands), float(model.opt.timestep)
        at: Array = np.arange(round(self.time[-1] / dt), dtype=np.float64) * dt
        ctrl = np.zeros((count, len(at), model.nu))
        laws = self.bench.dataset.mapping.controls
        for i, name in enumerate(self.room.names):
            a = actuator_names(model).index(name.removeprefix("ctrl:"))
            for row in range(count):
                ctrl[row, :, a] = commanded(self.time, commands[row, :, i], at, dt, laws[name].hold == "linear")
        bound = servos(model, self.bench.dataset.mapping.servo_laws)
        hold = lambda v: np.full((count, len(at)), float(np.median(v)))  # noqa: E731
        known = {}
        for key, values in log.known.items():
            field, _, of = key.partition(":")
            known[(field, tuple(of.split("+")) if of else ())] = hold(values)
        exogenous = {k: np.tile(at, (count, 1)) if k == TIME else hold(v) for k, v in log.exogenous.items()}
        return Segments(
            dt=dt,
            history=0,
            qpos=np.repeat(states.qpos[:1], count, 0),
            qvel=np.repeat(states.qvel[:1], count, 0),
            ctrl=ctrl,
            exogenous=exogenous,
            known=known,
            channels=frozenset(log.channels),
            condition=np.full(count, log.condition),
            servo=[
                (law, {n: hold(log.servo[k][n]) for n in ("gain", "supply", "damping")}) for k, law in bound.items()
            ],
        )

    def overstep(self, w: Array, models: Sequence[tuple[Plant, Array]] = ()) -> Array:
        """(N,) by how much the motion under sequences (N, T, nu) in -1..1 leaves what is allowed; 0 within it.

        Args:
          models: whose motion must stay within bounds besides the stage's own.
        """
        models = [(self.plant, self.x), *(m for m in models if m[0] is not self.plant)]
        if self.open_loop:
            return self.motion(self.room.commands(w), models)[1]
        problem, over = self._added(w), np.zeros(len(w))
        for plant, x in models:
            t = plant.shoot(x[None], problem.segments)
            each = np.where(t.stable[0], self.envelope.overstep(t.qpos[0], t.qvel[0], moving=False), 1e3)
            each = np.where(each <= np.tile(self.allowed, len(w)), 0.0, each)
            np.maximum.at(over, problem.log_of // len(self.recorded), each)
        return over

    def data(self, w: Array) -> RolloutProblem:
        """What recordings of sequences (N, T, nu) would give, noise left out; each makes `parts` logs, in order."""
        if not self.open_loop:
            return self._added(w)
        commands = self.room.commands(w)
        return self._made(commands, self.motion(commands, [(self.plant, self.x)])[0][0])

    @property
    def parts(self) -> int:
        """Logs that one sequence makes in `data`."""
        return 1 if self.open_loop else len(self.recorded)

    def _made(self, commands: Array, motion: Trajectory) -> RolloutProblem:
        """Logs of simulated motions."""
        model = self.plant.model
        sd = self.bench.states[self.start.name]
        q_sd, v_sd = (np.tile(np.median(s, 0), (len(self.time), 1)) for s in (sd.qpos_sd, sd.qvel_sd))
        base = self.bench.rollouts([self.start], [sd])
        step = (self.time / float(model.opt.timestep))[None]
        step = np.minimum(step, motion.qpos.shape[2] - 1)
        logs, states = [], []
        for i in range(len(commands)):
            part = slice(i, i + 1)
            one = Trajectory(
                motion.qpos[:, part], motion.qvel[:, part], None, motion.stable[:, part], motion.touched[:, part]
            )
            at = lambda a: interpolate(a, step, False)[0, 0]  # noqa: E731
            qpos, qvel = at(one.qpos), at(one.qvel)
            states.append(States(qpos, qvel, np.zeros_like(qvel), q_sd, v_sd, sd.observed))
            channels = {}
            for o in base.observers:
                old = self.start.channels[o.name]
                values = np.zeros((len(self.time), *old.values.shape[1:]))
                if not o.needs_sensors:
                    values = interpolate(o.predict(one), step, o.quaternion)[0, 0].reshape(values.shape)
                channels[o.name] = replace(
                    old, values=values, noise=channel_noise(self.start, o.name), mask=None, rate=None
                )
            logs.append(self._log(f"proposal {i}", commands[i], channels))
        return self.bench.rollouts(logs, states, put_off=False)  # whatever the sequence, the same starts

    def _log(self, name: str, commands: Array, channels: dict) -> Log:
        start = self.start
        hold = lambda v: np.full(len(self.time), float(np.median(v)))  # noqa: E731
        return Log(
            name=name,
            time=self.time,
            controls={n: commands[:, i] for i, n in enumerate(self.room.names)},
            channels=channels,
            exogenous={k: self.time if k == TIME else hold(v) for k, v in start.exogenous.items()},
            known={k: hold(v) for k, v in start.known.items()},
            servo={k: {n: hold(v) for n, v in terms.items()} for k, terms in start.servo.items()},
            condition=start.condition,
        )

    def _added(self, w: Array) -> RolloutProblem:
        """Recorded stretches whose commands have sequences (N, T, nu) added to them."""
        logs, states = [], []
        for row in self.room.additions(w):
            began = 0.0
            for log, along in self.recorded:
                controls = {
                    n: np.clip(
                        log.controls[n] + np.interp(began + log.time, self.time, row[:, k]),
                        min(self.room.low[k], log.controls[n].min()),
                        max(self.room.high[k], log.controls[n].max()),
                    )
                    for k, n in enumerate(self.room.names)
                }
                logs.append(replace(log, controls=controls))
                states.append(along)
                began += log.duration
        return self.bench.rollouts(logs, states, put_off=False)  # whatever the sequence, the same starts


def _stretch(bench: Bench, logs: Sequence[Log], seconds: float) -> list[tuple[Log, States]]:
    """Recorded logs with their states, one after the other, until they fill the time."""
    out, filled = [], 0.0
    for log in logs:
        if filled >= seconds - 1e-6:
            break
        stop = max(int(np.searchsorted(log.time, seconds - filled + 1e-9)), 2)
        along = bench.states[log.name]
        keys = ("qpos", "qvel", "qacc", "qpos_sd", "qvel_sd")
        part = log.part(0, stop, log.name)
        out.append((part, replace(along, **{k: getattr(along, k)[:stop] for k in keys})))
        filled += part.duration
    return out
