"""Segments of logs as they are rolled out: states at their starts, and commands on the grid of physics steps."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.log import Inputs, Log
from nfc_gym.measured.cuts import Cut, Layout
from nfc_gym.measured.states import States
from nfc_gym.physics.effects.base import TIME
from nfc_gym.physics.past import Before, Past
from nfc_gym.physics.segments import Segments, Servo

Array = NDArray[np.float64]
# A log's commands before the history are thinned to as many steps as numbers of all starts together have room for.
_LEAD, _LEAST, _ROOM = 4000, 200, 1_000_000


def resample(time: Array, values: Array, at: Array, linear: bool) -> Array:
    """A sampled signal (T,) at other times: held from the last sample, or interpolated; its ends are held."""
    if linear:
        return np.interp(at, time, values)
    return values[np.clip(np.searchsorted(time, at + 1e-9, side="right") - 1, 0, len(time) - 1)]


def commanded(time: Array, values: Array, at: Array, dt: float, linear: bool) -> Array:
    """A command (T,) in physics steps of dt that begin at other times: interpolated, or what is held, on average.

    Where it changes within a step the step gets the mean, not all of the old value: a step of 4 ms under commands every
    10 ms would otherwise pass on every other command 2 ms late, which looks like a lag of the machine.
    """
    held = resample(time, values, at, linear)
    first, last = (np.searchsorted(time, t, side="right") for t in (at + 1e-9, at + dt - 1e-9))
    changed = np.flatnonzero(last > first) if not linear else first[:0]
    if not len(changed):
        return held
    rows = slice(max(int(first[changed].min()) - 1, 0), int(last[changed].max()) + 1)  # a log may be far longer
    out, begin = held.astype(float), at[changed]
    to, since = _integral(time[rows], values[rows], np.stack([begin + dt, begin]))
    out[changed] = (to - since) / dt
    return out


def _integral(time: Array, values: Array, at: Array) -> Array:
    """Of a held signal from the first sample to other times; the first value holds before it."""
    total = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(time))])
    beyond = values[-1] * np.maximum(at - time[-1], 0) + values[0] * np.minimum(at - time[0], 0)
    return np.interp(at, time, total) + beyond


def _thinned(time: Array, values: Array, edges: Array) -> Array:
    """A held command (T,) as slow effects may take it: in n steps of equal length, n even, between times (..., n + 1).

    Of every two steps the mean and the mean square are kept, and not each one's own mean: what heats a drive is the
    square of its command, and one that changes faster than the steps must not look like rest.
    """
    shape = *edges.shape[:-1], -1, 2
    means, squares = ((np.diff(_integral(time, v, edges)) / np.diff(edges)).reshape(shape) for v in (values, values**2))
    middle = means.mean(-1)
    spread = np.sqrt(np.maximum(squares.mean(-1) - middle**2, 0.0))
    spread *= np.where(middle < 0, -1.0, 1.0) * np.where(squares[..., 0] > squares[..., 1], 1.0, -1.0)  # hotter first
    return np.stack([middle + spread, middle - spread], -1).reshape(*edges.shape[:-1], -1)


def servos(model: mujoco.MjModel, laws: Mapping[str, tuple[str, float]]) -> dict[str, Servo]:
    """`ctrl:<actuator>` -> (joint, limit) bound to the model's addresses."""
    out = {}
    for control, (joint, limit) in laws.items():
        j = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
        a = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, control.removeprefix("ctrl:"))
        out[control] = Servo(a, int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j]), limit)
    return out


def served(log: Log, states: States, laws: Mapping[str, Servo]) -> dict[str, Array]:
    """`ctrl:<actuator>` -> (T,) what its firmware servo made of its goals, by the measured motion."""
    return {k: law.command(log.controls[k], states.qpos, states.qvel, log.servo[k]) for k, law in laws.items()}


def lay(
    model: mujoco.MjModel,
    logs: Sequence[Log],
    states: Sequence[States],
    where: Cut,
    layout: Layout,
    laws: Mapping[str, Servo],
    linear: frozenset[str] = frozenset(),
) -> Segments:
    """Lay cut segments on the physics grid.

    Args:
      laws: firmware servos by control.
      linear: controls that are interpolated between samples rather than held.
    """
    before = round(layout.history / layout.dt)
    after = int(np.ceil(where.step.max() - 1e-6)) + 1
    offsets = np.arange(-before, after) * layout.dt
    starts = [logs[i].time[s] for i, s in zip(where.log, where.start, strict=True)]

    def lane(series: Callable[[Inputs], Array], law: Callable[[Array, Array, Array], Array]) -> Array:
        along = zip(where.log, starts, strict=True)
        return np.stack([law(logs[i].inputs.time, series(logs[i].inputs), t + offsets) for i, t in along])

    held, straight = partial(resample, linear=False), partial(resample, linear=True)
    ctrl = np.zeros((len(where.log), len(offsets), model.nu))
    for key in logs[0].controls:
        a = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, key.removeprefix("ctrl:"))
        ctrl[:, :, a] = lane(lambda log, k=key: log.controls[k], partial(commanded, dt=layout.dt, linear=key in linear))
    known = {}
    for key in logs[0].known:
        name, _, of = key.partition(":")
        known[(name, tuple(of.split("+")) if of else ())] = lane(lambda log, k=key: log.known[k], held)
    past = _Backwards(model, tuple(logs), tuple(states), where, layout, laws, linear)
    servo = []
    for key, law in laws.items():
        terms = {n: lane(lambda log, k=key, n=n: log.servo[k][n], held) for n in ("gain", "supply", "damping")}
        servo.append((law, terms))
    return Segments(
        dt=layout.dt,
        history=before,
        qpos=np.stack([states[i].qpos[s] for i, s in zip(where.log, where.start, strict=True)]),
        qvel=np.stack([states[i].qvel[s] for i, s in zip(where.log, where.start, strict=True)]),
        ctrl=ctrl,
        exogenous={
            k: lane(lambda log, k=k: log.exogenous[k], straight if k == TIME else held) for k in logs[0].exogenous
        },
        known=known,
        servo=servo,
        condition=np.array([logs[i].condition for i in where.log]),
        past=Past(past, np.arange(len(where.log))),
        channels=frozenset(logs[0].channels),
        qacc=np.stack([states[i].qacc[s] for i, s in zip(where.log, where.start, strict=True)]),
    )


def _map(segments: Segments, rows, qpos: Array, qvel: Array, past: Past | None) -> Segments:
    return replace(
        segments,
        qpos=qpos,
        qvel=qvel,
        ctrl=rows(segments.ctrl),
        exogenous={k: rows(v) for k, v in segments.exogenous.items()},
        known={k: rows(v) for k, v in segments.known.items()},
        servo=[(law, {n: rows(v) for n, v in terms.items()}) for law, terms in segments.servo],
        past=past,
    )


def pick(segments: Segments, index: NDArray[np.intp]) -> Segments:
    """Some of the segments."""
    past = segments.past and segments.past.pick(index)
    picked = _map(segments, lambda a: a[index], segments.qpos[index], segments.qvel[index], past)
    if segments.qacc is not None:
        picked = replace(picked, qacc=segments.qacc[index])
    if segments.off is not None:
        picked = replace(picked, off=(segments.off[0][index], segments.off[1][index]))
    return picked if segments.condition is None else replace(picked, condition=segments.condition[index])


def moved(segments: Segments, qpos: Array, qvel: Array) -> Segments:
    """The segments from other starts: (S, nq) and (S, nv)."""
    return replace(segments, qpos=qpos, qvel=qvel, off=_off(segments, qpos, qvel, 1))


def _off(segments: Segments, qpos: Array, qvel: Array, n: int) -> tuple[Array, Array]:
    """(n S, nq), (n S, nv) by how much starts are off what was measured, those of the segments included."""
    dq, dv = (np.tile(a, (n, 1)) for a in (segments.qpos, segments.qvel))
    dq, dv = qpos - dq, qvel - dv
    if segments.off is None:
        return dq, dv
    return dq + np.tile(segments.off[0], (n, 1)), dv + np.tile(segments.off[1], (n, 1))


def repeat(segments: Segments, n: int, qpos: Array, qvel: Array) -> Segments:
    """The segments n times over, from other starts: (n S, nq) and (n S, nv)."""
    past = segments.past and segments.past.repeat(n)
    many = _map(segments, lambda a: np.concatenate([a] * n), qpos, qvel, past)
    many = replace(many, off=_off(segments, qpos, qvel, n))
    if segments.qacc is not None:
        many = replace(many, qacc=np.concatenate([segments.qacc] * n))
    return many if segments.condition is None else replace(many, condition=np.tile(segments.condition, n))


def refine(segments: Segments) -> Segments:
    """The same segments on a grid of half the step; commands are held, as on the coarse grid."""
    past = segments.past and segments.past.refine()
    fine = _map(segments, lambda a: np.repeat(a, 2, axis=1), segments.qpos, segments.qvel, past)
    return replace(fine, dt=segments.dt / 2, history=2 * segments.history, settle=2 * segments.settle)


@dataclass(frozen=True)
class _Backwards:
    """What came before some of the starts of a `Cut`."""

    model: mujoco.MjModel
    logs: tuple[Log, ...]
    states: tuple[States, ...]
    where: Cut
    layout: Layout
    laws: Mapping[str, Servo]
    linear: frozenset[str]

    def __call__(self, index: NDArray[np.intp]) -> Before:
        dt = self.layout.dt
        offsets = np.arange(-round(self.layout.history / dt), 1) * dt
        of = [
            (self.logs[i], self.states[i], s)
            for i, s in zip(self.where.log[index], self.where.start[index], strict=True)
        ]
        motion = [_motion(log, states, log.time[s] + offsets) for log, states, s in of]
        lead, step = self._lead(index, float(offsets[0]))
        return Before(np.stack([q for q, _ in motion]), np.stack([v for _, v in motion]), lead, step)

    def _lead(self, index: NDArray[np.intp], begin: float) -> tuple[Array, float]:
        """(n, B, nu) commands up to where histories `begin`, s after the starts, and the length of their steps, s.

        B is that of all of the cut's starts, whichever are asked for: parts of a problem predict what the whole does.
        What is slow is the drive's: of a firmware servo the commands are those that it made of its goals.
        """
        model, where = self.model, self.where
        starts = np.array([self.logs[i].time[s] for i, s in zip(where.log, where.start, strict=True)]) + begin
        longest = float(np.max(starts - np.array([log.inputs.time[0] for log in self.logs])[where.log]))
        whole = max(int(np.ceil(longest / self.layout.dt - 1e-6)), 0)
        most = int(np.clip(_ROOM // max(len(starts) * model.nu, 1), _LEAST, _LEAD)) // 2 * 2
        count = min(whole, most)
        lead, step = np.zeros((len(index), count, model.nu)), longest / count if count else 0.0
        for i in np.unique(where.log[index]) if count else ():
            rows, log, inputs = np.flatnonzero(where.log[index] == i), self.logs[i], self.logs[i].inputs
            edges = starts[index[rows], None] - np.arange(count, -1, -1) * step
            made_of_goals = served(log, self.states[i], self.laws)
            for key, values in inputs.controls.items():
                a = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, key.removeprefix("ctrl:"))
                linear, time = key in self.linear, inputs.time
                if key in made_of_goals:  # which is known where the motion is
                    linear, time, values = False, log.time, made_of_goals[key]
                if count == whole:
                    made = commanded(time, values, edges[:, :-1].ravel(), step, linear).reshape(len(rows), count)
                else:  # a roll-out holds through each of its steps what is interpolated too
                    fine = np.arange(time[0], time[-1], self.layout.dt) if linear else time
                    made = _thinned(fine, resample(time, values, fine, linear), edges)
                lead[rows, :, a] = made
        return lead, step


def _motion(log: Log, states: States, at: Array) -> tuple[Array, Array]:
    """Estimated (n, nq) and (n, nv) at times (n,), linearly between samples; at rest before the log begins."""
    high = np.clip(np.searchsorted(log.time, at, side="right"), 1, len(log) - 1)
    share = np.clip((at - log.time[high - 1]) / (log.time[high] - log.time[high - 1]), 0, 1)[:, None]
    q, v = ((1 - share) * a[high - 1] + share * a[high] for a in (states.qpos, states.qvel))
    return q, np.where((at < log.time[0] - 1e-9)[:, None], 0.0, v)
