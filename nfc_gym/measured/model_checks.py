"""Whether a mapping and its model fit together: actuators, joints, bodies, sensors, parameters, known fields."""

import copy
from collections.abc import Iterator
from difflib import get_close_matches

import mujoco
import numpy as np

from nfc_gym.core import InputError
from nfc_gym.core.units import si_unit
from nfc_gym.measured.buffers import too_short
from nfc_gym.measured.channels import ChannelName, parse_channel
from nfc_gym.measured.export import unsaid
from nfc_gym.measured.findings import Finding
from nfc_gym.measured.inverse import require_told_apart
from nfc_gym.measured.mapping import Mapping
from nfc_gym.measured.observe import observer
from nfc_gym.measured.start_checks import unmeasured
from nfc_gym.measured.stiffness import stiffness_findings
from nfc_gym.measured.yaml_marks import suggest
from nfc_gym.physics.activations import integrators, on_servos
from nfc_gym.physics.effects.drive import command_unit, plain
from nfc_gym.physics.effects.lookup import actuator_names
from nfc_gym.physics.fields import ModelFields, names_of
from nfc_gym.physics.parameters import COMPOUND, Parameter, ParameterSpace, resolve, split_field

_OBJ = mujoco.mjtObj
_GOALS = ("rad", "m", "rad/s", "m/s")  # units that servos are commanded in, and nothing else
# Dynamics of actuators whose state the commands before a start tell.
_LED = [int(getattr(mujoco.mjtDyn, f"mjDYN_{kind}")) for kind in ("NONE", "FILTER", "FILTEREXACT", "INTEGRATOR")]
MOST_STEPS = 100_000  # of a segment with its history; usual are a hundred


def model_findings(mapping: Mapping, spec: mujoco.MjSpec, model: mujoco.MjModel) -> Iterator[Finding]:
    """Everything in the mapping that the model does not have, or has otherwise; `model` is what `spec` compiled to."""
    names = {
        "joint": names_of(model, _OBJ.mjOBJ_JOINT, model.njnt),
        "body": names_of(model, _OBJ.mjOBJ_BODY, model.nbody),
        "sensor": names_of(model, _OBJ.mjOBJ_SENSOR, model.nsensor),
        "actuator": names_of(model, _OBJ.mjOBJ_ACTUATOR, model.nu),
    }
    yield from _controls(mapping, names)
    yield from _command_units(mapping, model)
    for name, channel in mapping.channels.items():
        where, parsed = f"channels.{name}", parse_channel(name)
        absent = _absent(where, "actuator" if parsed.kind == "force" else parsed.kind, parsed.object, names)
        if absent is not None:
            yield absent
            continue
        try:
            observer(model, name, channel.axis_indices)
        except InputError as e:
            yield Finding("error", where, str(e).removeprefix(f"channel {name!r}: "))
            continue
        if parsed.kind == "joint":
            yield from _joint_unit(where, parsed, si_unit(channel.unit or "1"), model)
        if parsed.kind == "sensor":
            size = int(model.sensor_dim[mujoco.mj_name2id(model, _OBJ.mjOBJ_SENSOR, parsed.object)])
            if channel.axes and max(channel.axis_indices or ()) >= size:
                yield Finding("error", where, f"axes {list(channel.axes)} where the sensor has {size} components")
    yield from _compared(mapping, model)
    yield from unmeasured(mapping, model)
    yield from _fields(mapping, spec, model)
    yield from _steps(mapping, model)
    for short in too_short(model, float(model.opt.timestep)):
        yield Finding(
            "warning", "model", short, "MuJoCo delays by what they hold, without a word: give it more nsample"
        )
    yield from _unused(mapping)
    yield from _integrating(mapping, model)
    yield from _strange(model)
    if mapping.segments.mode == "rollout":
        yield from stiffness_findings(_nominal(mapping, model), float(mapping.segments.timestep or model.opt.timestep))


def _nominal(mapping: Mapping, model: mujoco.MjModel) -> mujoco.MjModel:
    """The model with its declared parameters at nominal, or as it is where they cannot be."""
    out = copy.copy(model)
    fields = ModelFields(out)
    try:
        space = ParameterSpace(model, mapping.declared)
    except (InputError, IndexError):
        return out
    space.write(fields, space.nominal)
    fields.commit()
    return out


def _controls(mapping: Mapping, names: dict[str, list[str]]) -> Iterator[Finding]:
    driven = set()
    for name, control in mapping.controls.items():
        actuator = name.removeprefix("ctrl:")
        driven.add(actuator)
        absent = _absent(f"controls.{name}", "actuator", actuator, names)
        if absent is not None:
            yield absent
        if control.servo is not None:
            absent = _absent(f"controls.{name}.servo.joint", "joint", control.servo.joint, names)
            if absent is not None:
                yield absent
    idle = [repr(a) for a in names["actuator"] if a not in driven]
    if idle and mapping.segments.mode != "inverse":
        advice = "name their columns under `controls`, or remove them from the model"
        yield Finding(
            "warning", "controls", f"no column drives actuator {', '.join(idle)}: 0 is sent throughout", advice
        )


def _command_units(mapping: Mapping, model: mujoco.MjModel) -> Iterator[Finding]:
    """Commands in units that their actuators do not take: a servo wants its goal, a motor no place and no speed."""
    for name, control in mapping.controls.items():
        a = mujoco.mj_name2id(model, _OBJ.mjOBJ_ACTUATOR, name.removeprefix("ctrl:"))
        unit = si_unit(control.unit or "1")
        if a < 0 or control.servo is not None or unit == "1":
            continue
        wanted = command_unit(model, a)
        fits = unit == wanted if wanted in _GOALS else unit not in _GOALS
        if not fits:
            want = wanted if wanted in _GOALS else "a force, a torque or what stands for one, such as N m, A or V"
            message = f"the actuator is commanded in {wanted}, but the unit is {unit!r}"
            yield Finding("warning", f"controls.{name}", message, f"want {want}; or 1 for none")


def _absent(where: str, kind: str, name: str, names: dict[str, list[str]]) -> Finding | None:
    if name in names[kind]:
        return None
    return Finding("error", where, f"the model has no {kind} {name!r}", suggest(name, [n for n in names[kind] if n]))


def _joint_unit(where: str, parsed: ChannelName, unit: str, model: mujoco.MjModel) -> Iterator[Finding]:
    joint = mujoco.mj_name2id(model, _OBJ.mjOBJ_JOINT, parsed.object)
    slides = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
    wanted = parsed.units[1 if slides else 0]
    if unit != wanted:
        kind = "slides" if slides else "turns"
        yield Finding("error", where, f"joint {parsed.object!r} {kind}, but the unit is {unit!r}", f"want {wanted}")


def _fields(mapping: Mapping, spec: mujoco.MjSpec, model: mujoco.MjModel) -> Iterator[Finding]:
    right: dict[str, str] = {}
    every: list[Parameter] = []
    for i, entry in enumerate(mapping.parameters):
        where = f"parameters.{i} ({entry.name})"
        try:
            for parameter in entry.expand():
                ParameterSpace(model, [parameter])
                right[parameter.name] = where
                every.append(parameter)
                yield from _doubtful(where, model, parameter)
        except (InputError, IndexError) as e:
            yield Finding("error", where, str(e), _field_advice(entry.field, model))
    try:
        ParameterSpace(model, every)
        lost = unsaid(spec, every)
    except InputError as e:
        lost = []
        yield Finding("error", "parameters", str(e))
    for name in lost:
        field = next(p.field for p in every if p.name == name)
        message = f"{field} is nothing that model.xml can say: MuJoCo derives it from other fields, or changes it"
        yield Finding("error", right[name], message, "name what it is made of")
    for entry in mapping.known:
        try:
            resolve(model, entry.field, entry.of)
        except (InputError, IndexError) as e:
            yield Finding("error", f"known.{entry.field}", str(e), _field_advice(entry.field, model))


def _doubtful(where: str, model: mujoco.MjModel, parameter: Parameter) -> Iterator[Finding]:
    """A parameter that may take what nature does not allow, or that makes alike what differs in the model."""
    space = ParameterSpace(model, [parameter])
    if parameter.low < space.least[0] or parameter.high > space.most[0]:
        allowed = (
            f"{space.least[0]:g} to {space.most[0]:g}" if space.most[0] < np.inf else f"{space.least[0]:g} or more"
        )
        bounds = f"[{parameter.low:g}, {parameter.high:g}]"
        yield Finding("warning", where, f"the bounds {bounds} reach beyond what nature allows, {allowed}")
    own = {float(f"{value:.6g}") for value in space.tied(model, 0)} if parameter.nominal is None else set()
    if len(own) > 1:
        message = f"one value for what differs in the model ({', '.join(f'{v:g}' for v in sorted(own))})"
        advice = f"before any fit all have {space.nominal[0]:g}; give `nominal`, or a parameter for each"
        yield Finding("warning", where, message, advice)


def _steps(mapping: Mapping, model: mujoco.MjModel) -> Iterator[Finding]:
    """Physics steps in a segment and its history: a step far too short would fill the memory, a long one miss it."""
    segments = mapping.segments
    step = float(segments.timestep or model.opt.timestep)
    count = (segments.length + segments.history) / step if step > 0 else float("inf")
    if segments.mode == "rollout" and not count <= MOST_STEPS:
        message = f"{segments.length:g} s and {segments.history:g} s of history are {count:.3g} steps of {step:g} s"
        advice = f"want at most {MOST_STEPS}: lengthen segments.timestep or the model's, or shorten the segments"
        yield Finding("error", "segments", message, advice)
    if segments.mode == "rollout" and step > segments.horizons[0]:
        message = f"one step of {step:g} s is longer than the shortest horizon, {segments.horizons[0]:g} s"
        advice = "give a shorter segments.timestep, mend the model's, or lengthen segments.length"
        yield Finding("error", "segments", message, advice)


def _integrating(mapping: Mapping, model: mujoco.MjModel) -> Iterator[Finding]:
    """Actuators that integrate their commands, of which a log does not say what they had gathered before."""
    names, rolled = names_of(model, _OBJ.mjOBJ_ACTUATOR, model.nu), mapping.segments.mode == "rollout"
    if mapping.segments.mode == "inverse":
        return
    for a in np.flatnonzero((model.actuator_actnum > 0) & ~np.isin(model.actuator_dyntype, _LED)):
        kind = str(mujoco.mjtDyn(int(model.actuator_dyntype[a]))).rpartition("mjDYN_")[2].rstrip(">").lower()
        message = f"an actuator with the dynamics {kind!r}: each roll-out begins with its state at 0"
        advice = "filters and integrators are led through the commands before it: use one of these"
        yield Finding("warning", f"controls.ctrl:{names[a]}", message, advice)
    shown = on_servos(model) if rolled else []
    for a in integrators(model):
        where = f"controls.ctrl:{names[a]}"
        if a in shown:
            message = "the servo integrates its command, and the log does not say what it had gathered before"
            advice = "each roll-out begins with its target where it holds the joint against gravity and damping"
            yield Finding("note", where, message, advice)
        else:
            begin = f"{mapping.segments.history:g} s before each start" if rolled else "where a log begins"
            message = f"the actuator integrates its command: what it had gathered is taken to be 0 {begin}"
            advice = "log what it has gathered, and make that the command of an actuator without dynamics"
            yield Finding("warning", where, message, advice)


def _strange(model: mujoco.MjModel) -> Iterator[Finding]:
    """Actuators whose force is none of a motor or a servo: what may be wrong with it the library does not know."""
    known = plain(model)
    if odd := [repr(n) for n in actuator_names(model) if n not in known]:
        message = f"the force of {', '.join(odd)} is none of a motor or a servo: what it may lack is not looked for"
        yield Finding("note", "model", message, "only whether its command comes late")


def _compared(mapping: Mapping, model: mujoco.MjModel) -> Iterator[Finding]:
    """What the mode compares: there must be some, and forces must be those that a motion tells."""
    mode = mapping.segments.mode
    kind = {"inverse": "force", "forward": "sensor"}.get(mode)
    if kind is None:
        return
    found = [c.removeprefix(f"{kind}:") for c in mapping.channels if c.startswith(f"{kind}:")]
    if not found:
        advice = f"map one, {kind}:<{'actuator' if kind == 'force' else 'name'}>, or choose another mode"
        yield Finding("error", "segments", f"mode {mode} compares {kind}: channels, and there is none", advice)
    known = actuator_names(model)
    for name in found if mode == "inverse" else ():
        if name not in known:
            continue  # told of the channel
        try:
            require_told_apart(model, [known.index(name)])
        except InputError as e:
            message, _, advice = str(e).rpartition("; ")
            yield Finding("error", f"channels.force:{name}", message.removeprefix(f"force:{name} "), advice)


def _unused(mapping: Mapping) -> Iterator[Finding]:
    """What a mapping says in vain in its mode."""
    mode = mapping.segments.mode
    if mode == "rollout":
        return
    for name, control in mapping.controls.items():
        if control.servo is not None:
            advice = "give the command that the actuator gets, or use mode: rollout"
            yield Finding(
                "warning", f"controls.{name}.servo", f"a servo acts in roll-outs alone, not in mode {mode}", advice
            )
    for entry in mapping.known if mode == "forward" else ():
        advice = "use mode: rollout, or name it under `parameters`"
        yield Finding("warning", f"known.{entry.field}", "is not written to the model in mode forward", advice)


def _field_advice(field: str, model: mujoco.MjModel) -> str:
    """Nearest field name, where the field itself does not exist."""
    try:
        name = split_field(field)[0].removeprefix("opt.")
    except InputError:
        return ""
    owner = model.opt if field.startswith("opt.") else model
    fields = [n for n in dir(owner) if not n.startswith("_")]
    close = [] if name in fields or name in COMPOUND else get_close_matches(name, fields, 1)
    return f"did you mean {close[0]!r}?" if close else ""
