"""What looks wrong in one log's signals: units, orders, clipping, pauses. Judged, never repaired."""

from collections.abc import Iterator
from collections.abc import Mapping as Dict

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core import Channel, Log
from nfc_gym.measured.channels import parse_channel
from nfc_gym.measured.findings import Suspicion
from nfc_gym.measured.frame_checks import exchanged
from nfc_gym.measured.glitch_checks import glitches
from nfc_gym.measured.mapping import Mapping
from nfc_gym.measured.observe import is_orientation
from nfc_gym.measured.rotation_checks import gravity, orientation, rate
from nfc_gym.measured.speed_checks import DEGREES, TURN, explained, rate_ratio, ratio, strangers, too_fast
from nfc_gym.measured.start_checks import open_loops
from nfc_gym.physics.effects.drive import command_unit, is_position

Array = NDArray[np.float64]

MANY_TURNS = 4 * np.pi  # rad; a joint that goes further may be in degrees, unless it is a wheel

_RUNS = 20  # changes of a value from which on it is told whether they come at a beat
_TOUCHES = (int(mujoco.mjtSensor.mjSENS_TOUCH), int(mujoco.mjtSensor.mjSENS_CONTACT))
_PILE = 5  # times as often as the step beside it that a clipped speed's extreme is
_ALIKE = 0.8  # share of them that are as many rows apart: an encoder's steps are not


def suspicions(mapping: Mapping, model: mujoco.MjModel | None, log: Log) -> Iterator[Suspicion]:
    """Everything in a log that looks wrong, in the order of the mapping; `model` None leaves out what needs one."""
    yield from _sampling(log)
    for name, values in log.controls.items():
        yield from _command(name, values, None if name in log.servo else model)  # a servo's goal is no ctrl
    for name, channel in log.channels.items():
        yield from _any_channel(name, channel, mapping, model)
        yield from _held(name, channel, log)
        parsed = parse_channel(name)
        if parsed.kind == "joint" and parsed.quantity == "pos" and channel.unit == "rad":
            yield from _angle(name, log, model)
        if parsed.quantity == "quat":
            yield from orientation(name, log, mapping.channels[name].order == "xyzw")
        if channel.unit == "rad/s" and parsed.kind in ("sensor", "body"):
            yield from rate(name, channel)
        if model is not None and parsed.kind == "sensor":
            yield from _components(name, parsed.object, channel, model)
            yield from _orientation_sensor(name, parsed.object, mapping, model)
            yield from gravity(name, parsed.object, channel, model)
    if mapping.segments.mode == "inverse":
        for name, values in log.known.items():
            if np.ptp(values) > 0:
                message = (
                    f"changes from {values.min():.4g} to {values.max():.4g}, and mode inverse takes its first value"
                )
                yield Suspicion(
                    "warning", f"known.{name.split(':')[0]}", "known", message, "cut the log where it changes"
                )
    yield from glitches(log)
    yield from exchanged(model, log)
    yield from strangers(log)
    yield from too_fast(log)
    yield from _twins(log)
    if model is not None:
        yield from open_loops(model, log)


def _sampling(log: Log) -> Iterator[Suspicion]:
    step = np.diff(log.time)
    median = float(np.median(step))
    pauses = np.flatnonzero(step > 2.5 * median)
    if pauses.size:
        k = int(pauses[0])
        many = f"{pauses.size} pause{'s' * (pauses.size > 1)} over 2.5 sampling intervals"
        message = f"{many}, the first of {step[k]:.3g} s at {log.time[k]:.4g} s"
        yield Suspicion(
            "warning", "time", "pause", message, "look for lost samples; segments across them are less certain"
        )
    spread = float(np.percentile(step, 95) - np.percentile(step, 5)) / median
    if spread > 0.5:
        message = f"sampling is jittered: nine in ten intervals spread over {spread:.0%} of the median {median:.3g} s"
        yield Suspicion("warning", "time", "jitter", message, "use the sensor's own time stamps, if it has them")
    if not 1e-5 < median < 1.0:
        message = f"samples are {median:.3g} s apart"
        severity = "warning" if 1e-7 < median < 60.0 else "error"  # no robot is measured so
        yield Suspicion(severity, "time", "unit", message, "check `time.unit` (s, ms, us or ns) or `time.interval`")


def _command(name: str, values: Array, model: mujoco.MjModel | None) -> Iterator[Suspicion]:
    where = f"controls.{name}"
    if np.ptp(values) == 0:
        message = f"constant ({values[0]:g})"
        yield Suspicion(
            "warning", where, "constant", message, "nothing can be learnt of this actuator; is it the right column?"
        )
        return
    actuator = (
        -1 if model is None else mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name.removeprefix("ctrl:"))
    )
    if model is not None and actuator >= 0 and model.actuator_ctrllimited[actuator]:
        low, high = model.actuator_ctrlrange[actuator]
        slack = 1e-6 * (high - low)
        beyond = float(((values < low - slack) | (values > high + slack)).mean())
        stops = [stop for stop in (low, high) if stop != 0]  # a command of 0 is an idle actuator, not a saturated one
        at = float(np.any([np.abs(values - stop) <= slack for stop in stops], axis=0).mean())
        if beyond:
            message = (
                f"{beyond:.1%} of the samples lie beyond the actuator's ctrlrange [{low:g}, {high:g}], the farthest "
            )
            message += f"{values[np.abs(values - (low + high) / 2).argmax()]:.4g}"
            yield Suspicion(
                "warning", where, "beyond", message, "the model clips them: check the unit, or widen ctrlrange"
            )
        elif at > 0.05:
            message = f"saturated: {at:.1%} of the samples sit at the ctrlrange [{low:g}, {high:g}]"
            yield Suspicion(
                "warning", where, "saturated", message, "record gentler commands, which say more about the actuator"
            )


def _components(name: str, sensor: str, channel: Channel, model: mujoco.MjModel) -> Iterator[Suspicion]:
    """A sensor measured in some of its components, without a word on which."""
    at = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, sensor)
    size, width = int(model.sensor_dim[at]) if at >= 0 else 0, int(np.prod(channel.values.shape[1:], dtype=int))
    if at >= 0 and channel.axes is None and width != size:
        message = f"{width} column{'s' * (width > 1)} where the sensor has {size} component{'s' * (size > 1)}"
        advice = "name all in `columns`, or say in `axes` which components these are"
        yield Suspicion("error", f"channels.{name}", "components", message, advice)


def _orientation_sensor(name: str, sensor: str, mapping: Mapping, model: mujoco.MjModel) -> Iterator[Suspicion]:
    """An orientation without a word on its scalar order, such a word on another sensor, and what mode forward lacks."""
    at = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, sensor)
    if at < 0:
        return
    where, order = f"channels.{name}", mapping.channels[name].order
    if not is_orientation(model, at):
        if order is not None:
            message = f"`order` is for orientations, and sensor {sensor!r} of the model reads none"
            yield Suspicion("error", where, "order", message, "leave `order` out")
    elif order is None:
        message = f"sensor {sensor!r} of the model reads an orientation, and nothing says which column is the scalar"
        advice = "say `order`: wxyz is scalar first (MuJoCo), xyzw scalar last (ROS, scipy, Vicon)"
        yield Suspicion("error", where, "order", message, advice)
    elif mapping.segments.mode == "forward":
        message = "mode forward compares no orientations"
        yield Suspicion("error", where, "forward", message, "leave the channel out, or use roll-outs")


def _held(name: str, channel: Channel, log: Log) -> Iterator[Suspicion]:
    """A sensor slower than the log whose values are repeated until it has a new one, without a word on it."""
    if channel.rate is not None or channel.mask is not None or not np.isfinite(channel.values).all():
        return
    rows = channel.values.reshape(len(channel.values), -1)
    runs = np.diff(np.flatnonzero((np.diff(rows, axis=0) != 0).any(1)))  # rows between two changes
    if len(runs) < _RUNS:
        return
    often = int(np.median(runs))
    if often > 1 and float((runs == often).mean()) > _ALIKE:
        hertz = 1 / (often * float(np.median(np.diff(log.time))))
        message = f"each value stands {often} rows long: it is held until the sensor, which is slower, has a new one"
        yield Suspicion("warning", f"channels.{name}", "held", message, f"say `rate: {hertz:.4g}`")


def _touches(name: str, model: mujoco.MjModel | None) -> bool:
    """Whether a channel is that of a touch sensor, which is 0 wherever nothing presses on it."""
    if model is None or not name.startswith("sensor:"):
        return False
    at = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name.removeprefix("sensor:"))
    return at >= 0 and int(model.sensor_type[at]) in _TOUCHES


def _any_channel(name: str, channel: Channel, mapping: Mapping, model: mujoco.MjModel | None) -> Iterator[Suspicion]:
    where = f"channels.{name}"
    columns = mapping.channels[name].columns
    values = channel.values.reshape(len(channel.values), -1)
    compared = values if channel.mask is None else values[channel.mask]
    if channel.mask is not None and not channel.mask.any():
        yield Suspicion(
            "warning", where, "masked", "its mask is false in every row", "name a mask that is true somewhere"
        )
        return
    still = np.flatnonzero(np.ptp(compared, axis=0) == 0)
    if _touches(name, model) and not (compared.any() and len(still)):
        if len(still):
            yield Suspicion("note", where, "untouched", "0 throughout: nothing touches it", "")
        return
    if len(still) == values.shape[1]:
        message = f"constant ({', '.join(f'{v:g}' for v in compared[0])})"
        yield Suspicion("warning", where, "constant", message, "name the right column, or leave the channel out")
    elif mapping.channels[name].order is None:
        names = [columns[i] if len(columns) == values.shape[1] else f"{columns[0]}[{i}]" for i in still]
        if names and not name.startswith("body:"):  # a body may well stay in a plane
            message = f"constant in {', '.join(names)}"
            yield Suspicion(
                "warning", where, "constant part", message, "name the right column, or leave the component out"
            )
        for i in range(values.shape[1]):
            if name.startswith(("sensor:", "force:")):
                yield from _clipped(where, compared[:, i], 0.02)
            elif not name.endswith((":pos", ":quat")):  # a joint may well rest at the end of its travel
                yield from _clipped(where, compared[:, i], 0.02, rests=True)


def _clipped(where: str, values: Array, share: float, rests: bool = False) -> Iterator[Suspicion]:
    """Many samples at exactly the largest or smallest value of a signal that otherwise takes many values.

    Args:
      where: what the finding names.
      values: (T,); NaN where a slower sensor has no sample.
      share: of the samples from which on they are many.
      rests: the signal is a speed: it may well be 0 for long, and where counts make steps of it (an encoder's) it is
        clipped only if its extreme is far oftener than the step beside it.
    """
    values = values[np.isfinite(values)]
    steps, often = np.unique(values, return_counts=True)
    if len(values) < 50 or len(steps) < 30:
        return
    for edge, beside in ((-1, -2), (0, 1)):
        at = float(often[edge] / len(values))
        if at > share and not (rests and (steps[edge] == 0 or often[edge] < _PILE * often[beside])):
            message = f"{at:.1%} of the samples are exactly {steps[edge]:.5g}, its extreme: clipped?"
            yield Suspicion(
                "warning", where, "clipped", message, "mask the rows where the reading is cut off (`mask: <column>`)"
            )


def _angle(name: str, log: Log, model: mujoco.MjModel | None) -> Iterator[Suspicion]:
    where, joint = f"channels.{name}", parse_channel(name).object
    values = log.channels[name].values
    jump = np.abs(np.diff(values))
    if ((jump > TURN[0]) & (jump < TURN[1])).any() and jump.max() < TURN[1]:
        row = int(jump.argmax()) + 1
        message = f"jumps by {jump.max():.3g} rad at row {row}: wrapped at a full turn?"
        yield Suspicion("error", where, "wrapped", message, "unwrap the column (numpy.unwrap) before it is read")
        return
    speed = log.channels.get(f"joint:{joint}:vel")
    if speed is not None and speed.values.shape == values.shape:
        found = rate_ratio(log, values, speed.values, (log.channels[name].mask, speed.mask))
        if found is not None:  # its own speed is the best witness
            yield from explained(where, found)
            return
    for command in _position_commands(joint, log, model):
        farther = ratio(command, values)
        for factor, what in ((DEGREES, "the angle is in degrees"), (1 / DEGREES, "the command is in degrees")):
            near = 0.35 if np.abs(command).max() < MANY_TURNS else 0.7  # no joint is told to turn so far
            if farther is not None and farther > 0 and abs(np.log(farther / factor)) < near:
                message = f"moves {farther:.3g} times as far as it is commanded: {what} where radians are declared"
                yield Suspicion("error", where, "degrees", message, "say `unit: deg`")
                return
    yield from _too_far(where, joint, values, model)


def _too_far(where: str, joint: str, values: Array, model: mujoco.MjModel | None) -> Iterator[Suspicion]:
    far = float(np.abs(values).max())
    j = -1 if model is None else mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
    if model is not None and j >= 0 and model.jnt_limited[j]:
        low, high = model.jnt_range[j]
        reach = max(abs(low), abs(high))
        if far > 2 * reach:
            message = (
                f"reaches {far:.4g} rad where the model's joint range is [{low:.3g}, {high:.3g}]: degrees for radians?"
            )
            yield Suspicion(
                "error", where, "degrees", message, "say `unit: deg`, or correct the joint's range in the model"
            )
            return
    if (
        far > MANY_TURNS
        and not _driven_by_speed(joint, model)
        and np.abs(values[-1] - values[0]) < 0.5 * np.abs(np.diff(values)).sum()
    ):
        message = f"reaches {far:.4g} rad, {far / (2 * np.pi):.0f} turns, and comes back: degrees for radians?"
        yield Suspicion("warning", where, "degrees", message, "say `unit: deg` if so")


def _driven_by_speed(joint: str, model: mujoco.MjModel | None) -> bool:
    """Whether a servo commands the joint's speed, as it does a wheel's."""
    if model is None:
        return False
    j = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
    moved = (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)) & (model.actuator_trnid[:, 0] == j)
    return j >= 0 and any(command_unit(model, int(a)) == "rad/s" for a in np.flatnonzero(moved))


def _position_commands(joint: str, log: Log, model: mujoco.MjModel | None) -> Iterator[Array]:
    """Commands that are goals for a joint's position: of position servos in the model."""
    if model is None:
        return
    for name, values in log.controls.items():
        a = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name.removeprefix("ctrl:"))
        if a < 0 or not (is_position(model, a) or name in log.servo):
            continue
        if mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, int(model.actuator_trnid[a, 0])) == joint:
            yield values


def _twins(log: Log) -> Iterator[Suspicion]:
    """Channels with the same numbers throughout are a slip; commands may be meant so, and are told in one note."""
    channels = {name: c.values for name, c in log.channels.items()}
    for name, other in _same(channels).items():
        advice = "name the right column, or remove one of the two"
        yield Suspicion("error", f"channels.{name}", "twin", f"the same numbers as {other} throughout", advice)
    same = _same(log.controls)
    if same:
        message = ", ".join(f"{name} commands what {other} does" for name, other in same.items())
        advice = "if that is not meant, name the right columns; if it is, their effects are hard to tell apart"
        yield Suspicion("note", "controls", "twin", message, advice)


def _same(signals: Dict[str, Array]) -> dict[str, str]:
    """Signal -> the first one before it that has the same numbers; constant ones are left out."""
    moving = {name: values for name, values in signals.items() if np.ptp(values) > 0}
    names = list(moving)
    found = {}
    for i, name in enumerate(names):
        other = next((n for n in names[:i] if np.array_equal(moving[n], moving[name])), None)
        if other is not None:
            found[name] = other
    return found
