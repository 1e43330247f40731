"""Cutting logs into segments: starts, commands on the grid of physics steps, and where the samples fall on it."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Inputs, Log
from nfc_gym.measured.channels import parse_channel
from nfc_gym.measured.states import States
from nfc_gym.physics.effects.base import TIME
from nfc_gym.physics.past import Before, Past
from nfc_gym.physics.segments import Segments, Servo

Array = NDArray[np.float64]
# A log's commands before the history are thinned to as many steps as numbers of all starts together have room for.
_LEAD, _LEAST, _ROOM = 4000, 200, 1_000_000
_STEP, _SHARE = 8.0, 0.02  # times its usual change from row to row, and of its range, from which a command steps
_AROUND = 3  # rows on either side of a start from which its state is estimated
_SETTLED = 0.05  # s after a step in which late drives may still pass it on
_WINDOW = 7  # samples that states are told by (`estimate_states`)
_SPARSE = 2.0  # times as far apart as usual that they may lie
_PUT_OFF = 0.5  # of a stride, at most, by which a start is put off


@dataclass(frozen=True)
class Layout:
    """How logs are cut.

    Attributes:
      length: s, of a segment.
      history: s of commands before its start.
      horizons: s after the start at which prediction and measurement are compared.
      stride: s between starts; the length where segments follow each other.
      dt: physics step, s.
      put_off: whether a start waits until no command steps beside it; not where states are known and not estimated.
      unknown: s from a log's beginning in which commands before it, of which it does not tell, are still felt; no
        segment starts there, short of half the log.
    """

    length: float
    history: float
    horizons: tuple[float, ...]
    stride: float
    dt: float
    put_off: bool = True
    unknown: float = 0.0


@dataclass(frozen=True)
class Cut:
    """Where each of S segments lies in its log.

    Attributes:
      log: (S,) index of the log.
      start: (S,) sample at which the segment starts.
      samples: (S, h) sample nearest to each horizon.
      step: (S, h) the samples' times on the physics grid, in steps after the start (not whole numbers).
    """

    log: NDArray[np.intp]
    start: NDArray[np.intp]
    samples: NDArray[np.intp]
    step: Array


def _stepped(log: Log) -> NDArray[np.bool_]:
    """(T,) rows at which a command steps: changes by much more than it usually does from one row to the next."""
    out = np.zeros(len(log), bool)
    for values in log.controls.values():
        change, range_ = np.abs(np.diff(values)), np.ptp(values)
        out[1:] |= change > max(_STEP * float(np.median(change)), _SHARE * float(range_))
    return out


def _calm(log: Log) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(T,) rows whose state may be estimated from the rows around; and of these the ones that late drives suit too.

    Where a command steps so does the acceleration, and a smooth curve through the rows on both sides has a wrong slope
    there: always to the side of the command, as if a gain, an inertia or an offset were off.
    """
    rows, settled = np.flatnonzero(_stepped(log)), round(_SETTLED / log.interval)
    near, late = (_between(len(log), rows - _AROUND + 1, rows + _AROUND + more) for more in (0, settled))
    return ~near, ~late


def _between(size: int, first: NDArray[np.intp], end: NDArray[np.intp]) -> NDArray[np.bool_]:
    """(size,) which rows lie in any of the stretches that begin at `first` and end before `end`."""
    edges = np.zeros(size + 1, int)
    np.add.at(edges, np.clip(first, 0, size), 1)
    np.add.at(edges, np.clip(end, 0, size), -1)
    return np.cumsum(edges[:-1]) > 0


def _put_off(log: Log, row: int, calm: tuple[NDArray[np.bool_], NDArray[np.bool_]], until: float) -> int:
    """The first calm row from a row on whose time is no later than `until`; the row itself where none is."""
    end = int(np.searchsorted(log.time, until + 1e-9, side="right"))
    for each in reversed(calm):
        found = np.flatnonzero(each[row:end])
        if len(found):
            return row + int(found[0])
    return row


def _seen(log: Log) -> NDArray[np.bool_]:
    """(T,) rows whose state is told by rows close by, in all channels that states come from.

    The cubics of states go through seven samples. Where these lie twice as far apart as they usually do, in a stretch
    that is masked, what a cubic cannot follow is no longer small beside the noise, and nothing tells how large it is.
    """
    out = np.ones(len(log), bool)
    for name, channel in log.channels.items():
        if channel.mask is None or parse_channel(name).kind not in ("joint", "body"):
            continue
        index = np.flatnonzero(channel.mask)
        if len(index) <= _WINDOW:
            continue
        first = np.clip(np.searchsorted(index, np.arange(len(log))) - _WINDOW // 2, 0, len(index) - _WINDOW)
        begin, end = log.time[index[first]], log.time[index[first + _WINDOW - 1]]
        span = np.maximum(end, log.time) - np.minimum(
            begin, log.time
        )  # before a first sample and behind a last one too
        out &= span <= _SPARSE * np.median(span[index])
    return out


def _onward(seen: NDArray[np.bool_], row: int) -> int:
    """The first row from a row on that is told by rows close by; the number of rows where none is."""
    found = np.flatnonzero(seen[row:])
    return row + int(found[0]) if len(found) else len(seen)


def _nearest(time: Array, at: Array) -> NDArray[np.intp]:
    """(n,) rows whose time (T,), which increases, is nearest to other times (n,); of two as near the earlier."""
    after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    return after - (at - time[after - 1] <= time[after] - at)


def cut(logs: Sequence[Log], layout: Layout) -> Cut:
    """Place segments end to end in every log that is long enough; each holds a sample beside its start.

    A start near which a command steps is put off to where its state can be told (`Layout.put_off`), and those behind it
    with it. So is one in a stretch that is masked, however long that is, unless every start of the log would be.

    Raises:
      InputError: no log holds even one segment.
    """
    which, starts, samples, steps = [], [], [], []
    for i, log in enumerate(logs):
        last = log.time[-1] - max(layout.horizons) + 0.5 * log.interval
        calm, told = _calm(log), log.inputs.time[0] < log.time[0]
        late = 0.0 if told or not layout.put_off else min(layout.unknown, max(last, 0.0) / 2)
        seen = _seen(log)
        if not layout.put_off or not (seen & (log.time <= last + 1e-9)).any():
            seen[:] = True
        for count in itertools.count():
            begin = count * layout.stride + late
            if begin > last + 1e-9:
                break
            s = int(np.searchsorted(log.time, begin - 1e-9))
            if s >= len(log) - 1:  # the half interval that a log may be too short by reaches past its samples
                continue
            began = s
            s = _onward(seen, s)
            if s < len(log) - 1 and layout.put_off:
                later = _put_off(log, s, calm, min(log.time[s] + _PUT_OFF * layout.stride, last))
                s = _onward(seen, later)
            if s > began and not seen.all() and (s >= len(log) - 1 or log.time[s] > last + 1e-9):
                break
            late += float(log.time[s] - log.time[began])
            near = _nearest(log.time, log.time[s] + np.array(layout.horizons))
            if near.max() <= s:  # no sample lies as far after the start as any horizon
                continue
            which.append(i)
            starts.append(s)
            samples.append(near)
            steps.append((log.time[near] - log.time[s]) / layout.dt)
    if not which:
        longest = max(log.duration for log in logs)
        if longest >= max(layout.horizons):
            raise InputError(
                f"no segment of {max(layout.horizons):g} s holds a sample beside its start: they are "
                f"{min(log.interval for log in logs):.3g} s apart; check time.unit, or lengthen segments.length"
            )
        raise InputError(
            f"no log is long enough for one segment of {max(layout.horizons):g} s (the longest has {longest:.3g} s): "
            "shorten segments.length"
        )
    return Cut(np.array(which), np.array(starts), np.array(samples), np.array(steps))


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
    return picked if segments.condition is None else replace(picked, condition=segments.condition[index])


def repeat(segments: Segments, n: int, qpos: Array, qvel: Array) -> Segments:
    """The segments n times over, from other starts: (n S, nq) and (n S, nv)."""
    past = segments.past and segments.past.repeat(n)
    many = _map(segments, lambda a: np.concatenate([a] * n), qpos, qvel, past)
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
