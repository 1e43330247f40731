"""Signs and frames that are turned round: what the nominal model predicts far better with them the other way.

An encoder that counts backwards, a motor whose wires are swapped, poses in north-east-down: a loop would look for
physics that explains them, and find some. Short roll-outs of the nominal model, of the logs as they are and with one
thing turned, tell. Reported, never repaired.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import Channel, InputError, Log
from nfc_gym.measured.bench import Bench, make_bench
from nfc_gym.measured.channels import parse_channel
from nfc_gym.measured.dataset import Dataset
from nfc_gym.measured.findings import Finding
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.physics.effects.drive import on_scalar
from nfc_gym.physics.effects.lookup import actuator_names

Array = NDArray[np.float64]

LOGS, ROWS, BLOCKS = 4, 4000, 60  # of the data that are looked at: logs, rows from the middle of each, roll-outs
TURNS = 8  # that are rolled out at once: a batch takes room
AHEAD, SAMPLES = 0.1, 5  # s that roll-outs last, or so many sampling intervals where those are longer
BETTER = 0.5  # of the error as the log is, to which a turn must bring it, in the median roll-out
OFTEN, WORSE = 0.9, 0.05  # of the roll-outs, which a turn must make no worse than by so much
ALIKE = 1.5  # times the least error, up to which another turn explains it as well
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_ON_AXES = [int(getattr(mujoco.mjtSensor, f"mjSENS_{s}")) for s in ("ACCELEROMETER", "GYRO", "VELOCIMETER")]
_NED = np.array([1.0, -1.0, -1.0])  # from north-east-down and forward-right-down: half a turn about x, on both sides
_NED_QUAT = np.array([1.0, 1.0, -1.0, -1.0])


@dataclass(frozen=True)
class _Turn:
    """Something that may be the wrong way round, and the signs that turn it.

    Attributes:
      where: the key of the mapping.
      what: in words.
      advice: what to do.
      place: whose predictions tell (`Columns.place`); empty: of all that is measured.
      ctrl, qpos, qvel: index -> sign, of commands and of start states.
      measured: channel -> sign of each of its numbers.
    """

    where: str
    what: str
    advice: str
    place: str
    ctrl: Mapping[int, float] = field(default_factory=dict)
    qpos: Mapping[int, float] = field(default_factory=dict)
    qvel: Mapping[int, float] = field(default_factory=dict)
    measured: Mapping[str, Array] = field(default_factory=dict)


def turned_round(dataset: Dataset) -> Iterator[Finding]:
    """Joints, commands and frames that the nominal model wants the other way round; of equals the likeliest is told.

    Nothing is said where an actuator's commands are not in the logs: roll-outs would be of a machine that is let go.
    """
    commanded = {key.removeprefix("ctrl:") for key in dataset.mapping.controls}
    try:
        bench = make_bench(replace(dataset, logs=tuple(_middles(dataset.logs))), nthread=1)
        if not commanded.issuperset(actuator_names(bench.plant.model)):
            return
        logs = bench.dataset.logs
        ahead = max(AHEAD, SAMPLES * max(log.interval for log in logs))
        states = [bench.states[log.name] for log in logs]
        problem = bench.rollouts(logs, states, BLOCKS, (ahead,), judged=False)
    except InputError:  # told elsewhere
        return
    turns = list(_turns(bench))
    weighed = [w for w in zip(_left(bench, problem, turns), turns, strict=True) if w[0] < BETTER]
    told: set[str] = set()
    for left, turn in sorted(weighed, key=lambda w: w[0]):
        if turn.place in told:
            continue
        told.add(turn.place)
        also = [t.what for other, t in weighed if t.place == turn.place and t is not turn and other < ALIKE * left]
        message = f"{turn.what} looks turned round: with it the other way, the nominal model's error of the next "
        message += f"{ahead:.2g} s falls to {left:.0%}"
        message += f" (or with {' or '.join(also)} instead)" if also else ""
        yield Finding("warning", turn.where, message, turn.advice)


def _middles(logs: Sequence[Log]) -> Iterator[Log]:
    """The middle rows of a few logs."""
    for i in np.unique(np.linspace(0, len(logs) - 1, min(len(logs), LOGS)).round().astype(int)):
        log = logs[i]
        start = max(0, (len(log) - ROWS) // 2)
        yield log.part(start, min(start + ROWS, len(log)), log.name)


def _left(bench: Bench, problem: RolloutProblem, turns: Sequence[_Turn]) -> Iterator[float]:
    """Share of the error that each turn leaves, in the median roll-out; 1 where it is no clear gain."""
    before = problem.residual(bench.plant, bench.plant.null[None])[0]
    noise = np.maximum(problem.sensor_sd, np.finfo(float).eps)  # of a channel that never moves it comes out as 0
    for first in range(0, len(turns), TURNS):
        some = turns[first : first + TURNS]
        other = _turned(problem, some).residual(bench.plant, bench.plant.null[None])[0]
        for turn, after in zip(some, other.reshape(len(some), *before.shape), strict=True):
            own = np.array([not turn.place or place == turn.place for place in problem.columns.place])
            yield _share(before / noise, after / noise, own if own.any() else np.ones_like(own))


def _turned(problem: RolloutProblem, turns: Sequence[_Turn]) -> RolloutProblem:
    """The problem once for each turn, one after the other: roll-outs of all at once cost little more than of one."""
    size = len(problem)
    many = problem.take(np.tile(np.arange(size), len(turns)))
    ctrl, qpos, qvel = (values.copy() for values in (many.segments.ctrl, many.segments.qpos, many.segments.qvel))
    measured: dict[str, Array] = {}
    for k, turn in enumerate(turns):
        rows = slice(k * size, (k + 1) * size)
        for values, signs in ((ctrl, turn.ctrl), (qpos, turn.qpos), (qvel, turn.qvel)):
            for index, sign in signs.items():
                values[rows, ..., index] *= sign
        for name, signs in turn.measured.items():
            measured.setdefault(name, np.ones((len(many), 1, len(signs))))[rows] = signs
    return many.beginning(replace(many.segments, ctrl=ctrl, qpos=qpos, qvel=qvel), measured)


def _share(before: Array, after: Array, own: NDArray[np.bool_]) -> float:
    """What of errors (S, m) before, in units of their noise, is left after, by the numbers (m,) of a turn's own."""
    rms = lambda residual, of: np.sqrt(np.mean(residual[:, of] ** 2, 1))  # noqa: E731
    told = np.isfinite(before).all(1) & np.isfinite(after).all(1) & (rms(before, own) > 0)
    if not told.any():
        return 1.0
    whole, share = (rms(after, of)[told] / rms(before, of)[told] for of in (np.full_like(own, True), own))
    return float(np.median(share)) if np.mean(share < 1 + WORSE) > OFTEN and np.median(whole) < 1 + WORSE else 1.0


def _turns(bench: Bench) -> Iterator[_Turn]:
    """What the logs could have the wrong way round."""
    model, channels, controls = bench.plant.model, bench.dataset.logs[0].channels, bench.dataset.mapping.controls
    joints: dict[str, list[str]] = {}
    for name in channels:
        parsed = parse_channel(name)
        if parsed.kind == "joint":
            joints.setdefault(parsed.object, []).append(name)
    advice = "if so, change the sign of its columns in the logs, or turn the joint's axis in the model"
    for joint, names in joints.items():
        j, measured = model.joint(joint), dict.fromkeys(names, np.array([-1.0]))
        qpos, qvel = {int(j.qposadr[0]): -1.0}, {int(j.dofadr[0]): -1.0}
        where, what = f"channels.{names[0]}", f"joint {joint!r}"
        yield _Turn(where, what, advice, f"joint:{joint}", qpos=qpos, qvel=qvel, measured=measured)
    known = actuator_names(model)
    every = {key: known.index(key.removeprefix("ctrl:")) for key in controls}
    advice = "if so, change the sign of the column in the logs, or of the actuator's gear in the model"
    for key, at in every.items():
        yield _Turn(f"controls.{key}", f"the command {key!r}", advice, _driven(bench, key, at), ctrl={at: -1.0})
    if len(every) > 1:
        yield _Turn("controls", "every command", advice, "", ctrl=dict.fromkeys(every.values(), -1.0))
    advice = "positions want z upwards, attitudes x forwards and z upwards: (x, -y, -z) and (w, x, -y, -z)"
    for j in np.flatnonzero(model.jnt_type == _FREE):
        body, q, v = model.body(int(model.jnt_bodyid[j])).name, int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
        measured = {name: _ned(name, c) for name, c in channels.items() if name.startswith(f"body:{body}:")}
        carried = {name: c for name, c in channels.items() if _reads_axes(model, name, int(model.jnt_bodyid[j]))}
        if measured:
            qpos = dict(enumerate([*_NED, *_NED_QUAT], q))
            where, what = f"channels.{next(iter(measured))}", f"the frame of {body!r} (north-east-down?)"
            qvel = dict(enumerate([*_NED, *_NED], v))
            yield _Turn(where, what, advice, "", qpos=qpos, qvel=qvel, measured=measured)
            if carried:  # sensors on the body whose axes are forward-right-down as well
                all_of = measured | {name: _ned(name, c) for name, c in carried.items()}
                yield _Turn(where, f"{what} and its sensors", advice, "", qpos=qpos, qvel=qvel, measured=all_of)


def _driven(bench: Bench, key: str, actuator: int) -> str:
    """`joint:<name>` that a command drives; empty where it is another thing."""
    servo, model = bench.dataset.mapping.controls[key].servo, bench.plant.model
    if servo is not None:
        return f"joint:{servo.joint}"
    if not on_scalar(model, actuator):
        return ""
    return f"joint:{model.joint(int(model.actuator_trnid[actuator, 0])).name}"


def _reads_axes(model: mujoco.MjModel, name: str, body: int) -> bool:
    """Whether a channel is a sensor whose numbers are along a body's own axes."""
    parsed = parse_channel(name)
    at = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, parsed.object) if parsed.kind == "sensor" else -1
    if at < 0 or int(model.sensor_type[at]) not in _ON_AXES:
        return False
    site = int(model.sensor_objid[at])
    return int(model.site_bodyid[site]) == body and bool(np.isclose(abs(model.site_quat[site, 0]), 1))


def _ned(name: str, channel: Channel) -> Array:
    if parse_channel(name).quantity == "quat":
        return _NED_QUAT
    return _NED if channel.axes is None else _NED[list(channel.axes)]
