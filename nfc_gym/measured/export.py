"""Effects as plain data, and the corrected model as MJCF that plain MuJoCo loads."""

import copy
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.measured import asset_files
from nfc_gym.measured.distances import Model
from nfc_gym.measured.fit import Fit
from nfc_gym.measured.frozen import freeze, freeze_inertia
from nfc_gym.measured.moments import mend
from nfc_gym.physics.effects.air import hull, hull_mark
from nfc_gym.physics.effects.base import Effect, overrides
from nfc_gym.physics.effects.inertial import Moved, complete_inertia
from nfc_gym.physics.effects.places import body_ids
from nfc_gym.physics.effects.saved import from_row, to_row
from nfc_gym.physics.effects.timing import command_limits
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.parameters import Parameter, ParameterSpace
from nfc_gym.physics.quiet import compiled
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
_HOOKS_BEYOND = ("spec", "friction", "follow", "modulate", "force", "sense", "unsense")
READ_COMMANDS = ("backlash", "law_command")  # families whose laws of force read `Context.ctrl`
_SOFTNESS = ("dof_solref", "dof_solimp")
_SHAPES = {"geom_size", "geom_pos", "geom_quat"}
_OFF = 0.1  # of the way to a parameter's highest value, for a look at whether MJCF says it
_KEPT, _ROUNDED, _HAIR = 0.01, 1e-5, 1e-9  # of a change, of a value, of what is none: it may come back so much changed


def pack(fitted: Fit | Model) -> dict[str, Any]:
    """Psi and effects of a model as JSON-able data; `unpack` reads it back."""
    psi, thetas = fitted.plant.split(fitted.x)
    return {
        "psi": dict(zip(fitted.plant.space.names, map(float, psi), strict=True)),
        "effects": [to_row(e, t) for e, t in zip(fitted.plant.effects, thetas, strict=True)],
    }


def unpack(data: dict[str, Any], plant: Plant) -> tuple[Plant, Array]:
    """The plant with its effects, and the full parameter vector (size,).

    Raises:
      InputError: the data are not what `pack` makes, or of another model.
    """
    psi, rows = (data.get(k) for k in ("psi", "effects")) if isinstance(data, dict) else (None, None)
    if not isinstance(psi, dict) or not isinstance(rows, list):
        raise InputError("a fitted model has the keys psi (a mapping of names to numbers) and effects (a list)")
    for name, value in psi.items():
        if not isinstance(value, int | float) or not np.isfinite(float(value)):
            raise InputError(f"psi: {name} is {str(value)[:40]!r}; it must be a finite number")
    pairs = [from_row(row) for row in rows]
    whole = plant.with_effects([e for e, _ in pairs])
    return whole, np.concatenate([plant.space.vector(psi), *(theta for _, theta in pairs)])


def corrected(
    spec: mujoco.MjSpec, plant: Plant, x: Array, folder: Path | None = None, firmware: Collection[str] = ()
) -> tuple[str, list[Effect]]:
    """MJCF text with psi and every effect that MJCF can say, and the effects that it cannot.

    Effects that only edit model fields are carried through those fields, in the order in which they act. Others are
    carried by a structural edit of their own (a delay, a lag) where they have one; all the rest stays outside. The
    commands of an actuator pass through effects of one kind alone: outside effects would act before all that the model
    carries, and see another command than they were fitted with. Of an actuator whose commands a firmware makes of goals
    the model takes the drive's effects alone (`Effect.on_drive`): what happens to a goal happens outside.

    Args:
      spec: the model as it was given; its objects have the names of the plant's, which may lack some of them.
      plant: psi and effects.
      x: (size,) full parameter vector.
      folder: where the text will be written: files of meshes and textures are then named as seen from there, else by
        their whole paths.
      firmware: actuators with a firmware servo.

    Returns:
      The text, in whose comment stands which inertias are not as they were found, since no body can have them; and
      those of the plant's effects that stay outside.

    Raises:
      ValueError: the spec does not compile.
    """
    spec = spec.copy()
    model = freeze(spec)
    asset_files.absolute(spec, model)
    keys = _activations(spec, model)
    effects = [copy.deepcopy(e) for e in plant.effects]  # the plant's own are bound to its model
    whole = Plant(model, ParameterSpace(model, plant.space.parameters), effects)
    psi, thetas = whole.split(x)
    # What is not in the model finds these there as it found them in the nominal one.
    marks = {name: at for e in effects for name, at in e.marks(model).items()}
    hulls, centres = [hull(model, b) for b in range(model.nbody)], model.body_ipos.copy()
    pairs = list(zip(effects, thetas, strict=True))
    by_fields = [(e, t) for e, t in pairs if _edits_fields_alone(e) and not _moves_frame(e, spec)]
    fields = ModelFields(model, copy.copy(model))
    whole.space.write(fields, psi)
    for effect, theta in by_fields:
        effect.model(fields, theta)
    _soften(fields, whole, x)
    fields.commit()
    moved = {b for e in effects if isinstance(e, Moved) for b in body_ids(model, e.where).tolist()}
    moved |= set(np.flatnonzero((model.body_ipos != centres).any(1)).tolist())  # by psi
    marks |= {hull_mark(model.body(b).name): hulls[b] for b in moved}
    _say(spec, model, fields)
    carried = [e for e, _ in by_fields]
    carried += [e for e, t in pairs if e not in carried and not e.on_command and e.spec(spec, t)]
    outside = [e for e in effects if e not in carried and not e.on_command]
    if not any(e.family in READ_COMMANDS for e in outside):
        on_commands = [(e, t) for e, t in pairs if e.on_command and (e.on_drive or set(e.where).isdisjoint(firmware))]
        spec, by_spec = _on_commands(spec, on_commands)
        carried += by_spec
    for mark, at in marks.items():
        numeric = next((n for n in spec.numerics if n.name == mark), None) or spec.add_numeric(name=mark, size=len(at))
        numeric.data = at
    told = mend(spec, model)
    _settle_keys(spec, compiled(spec)[0], keys)
    compiled(spec)
    if told:
        spec.comment = "\n".join(filter(None, [spec.comment, *told]))
    text = spec.to_xml() if folder is None else asset_files.relative(spec.to_xml(), folder)
    return text, [own for own, e in zip(plant.effects, effects, strict=True) if e not in carried]


def unsaid(spec: mujoco.MjSpec, parameters: Sequence[Parameter]) -> list[str]:
    """Names of parameters whose values MJCF cannot say: MuJoCo derives them from others, or makes others of them.

    Args:
      spec: the model as it was given, which compiles.
      parameters: each is written a little off its nominal value, and looked for in what is loaded again.
    """
    spec = spec.copy()
    complete_inertia(spec)
    model = freeze(spec)
    asset_files.absolute(spec, model)
    if not _lost(spec, model, parameters):
        return []
    return [p.name for p in parameters if _lost(spec, model, [p])]


def _lost(spec: mujoco.MjSpec, model: mujoco.MjModel, parameters: Sequence[Parameter]) -> bool:
    """Whether a model with these parameters off their nominal values is another one after it was written and read."""
    spec, moved = spec.copy(), copy.copy(model)
    space, fields = ParameterSpace(model, parameters), ModelFields(moved, model)
    space.write(fields, space.nominal + np.where(space.high > space.nominal, _OFF * (space.high - space.nominal), 0.0))
    wanted = {name: np.array(values, float) for name, values in fields.touched.items()}
    fields.commit()
    try:
        _say(spec, moved, fields)
        made = mujoco.MjModel.from_xml_string(spec.to_xml())
    except ValueError:
        return True
    for name, values in wanted.items():
        found = np.asarray(getattr(made.opt if name.startswith("opt.") else made, name.removeprefix("opt.")))
        if found.shape != values.shape:
            return True
        change = np.abs(values - fields.nominal(name))
        if (np.abs(found - values) > _KEPT * change + _ROUNDED * np.abs(values) + _HAIR).any():
            return True
    return False


def _say(spec: mujoco.MjSpec, model: mujoco.MjModel, fields: ModelFields) -> None:
    """Write into a spec what was written into the model that it compiled to."""
    if _SHAPES & fields.touched.keys():  # of which the compiler would make other inertias
        freeze_inertia(spec, model)
    spec.copy_back(model)
    # What MuJoCo does not copy:
    for body in spec.bodies:
        body.gravcomp = model.body_gravcomp[body.id]
    if "actuator_delay" in fields.touched:
        for actuator in spec.actuators:
            actuator.delay = model.actuator_delay[actuator.id]
    if "jnt_actfrcrange" in fields.touched:
        for joint in spec.joints:
            joint.actfrcrange = model.jnt_actfrcrange[joint.id]
    if "tendon_lengthspring" in fields.touched:
        for tendon in spec.tendons:
            tendon.springlength = model.tendon_lengthspring[tendon.id]


def _edits_fields_alone(effect: Effect) -> bool:
    """Whether an effect edits the model through its fields, and does nothing else."""
    beyond = effect.on_command or any(overrides(effect, hook) for hook in _HOOKS_BEYOND)
    return overrides(effect, "model") and not beyond


def _moves_frame(effect: Effect, spec: mujoco.MjSpec) -> bool:
    """Whether an effect moves the centre of mass of a body whose frame MuJoCo would move with it."""
    bodies = [spec.body(name) for name in effect.where] if isinstance(effect, Moved) else []
    always, maybe = mujoco.mjtAlignFree.mjALIGNFREE_TRUE, mujoco.mjtAlignFree.mjALIGNFREE_AUTO
    chosen = (always, maybe) if spec.compiler.alignfree else (always,)
    return any(joint.align in chosen for body in bodies for joint in body.joints)


def _soften(fields: ModelFields, whole: Plant, x: Array) -> None:
    """Give dry friction the softness that it has with all effects, those outside too.

    They decide by the nominal model's friction whether it becomes sharp, and would find psi's and others' in this one.
    """
    every = ModelFields(copy.copy(whole.model), fields.nominal_model)
    whole.write(every, x)
    for name in _SOFTNESS:
        if name in every.touched:
            fields[name][...] = every[name]


def _on_commands(spec: mujoco.MjSpec, pairs: Sequence[tuple[Effect, Array]]) -> tuple[mujoco.MjSpec, list[Effect]]:
    """The spec with effects on commands, and those of them that it carries: all of an actuator's, or none."""
    kept = list(pairs)
    while True:
        tried = spec.copy()
        # Each acts before what the spec says already.
        lost = next((e for e, theta in reversed(kept) if not e.spec(tried, theta)), None)
        if lost is None:
            return tried, [e for e, _ in kept]
        kept = [(e, t) for e, t in kept if not set(e.where) & set(lost.where)]


def _activations(spec: mujoco.MjSpec, model: mujoco.MjModel) -> dict[str, Array]:
    """(nkey, n) states of each actuator that has any, in the keyframes; these are taken out of the spec's."""
    starts, counts = model.actuator_actadr, model.actuator_actnum
    found = {a.name: model.key_act[:, starts[a.id] : starts[a.id] + counts[a.id]].copy() for a in spec.actuators}
    for key in spec.keys:
        key.act = []
    return {name: act for name, act in found.items() if act.size}


def _settle_keys(spec: mujoco.MjSpec, model: mujoco.MjModel, known: dict[str, Array]) -> None:
    """Put the states of actuators back into keyframes; one that has its state from an effect is settled there."""
    if not model.na:
        return
    acts = np.zeros((model.nkey, model.na))
    for i in np.flatnonzero(model.actuator_actnum):
        low, high = command_limits(model, np.array([i]))
        settled = np.clip(model.key_ctrl[:, i : i + 1], low, high)
        at = int(model.actuator_actadr[i])
        acts[:, at : at + int(model.actuator_actnum[i])] = known.get(model.actuator(i).name, settled)
    for key, act in zip(spec.keys, acts, strict=True):
        key.act = act


def effects_of(plant: Plant, x: Array, which: Sequence[Effect] | None = None) -> list[tuple[Effect, Array]]:
    """(effect, theta) pairs of a fitted vector, all or some."""
    return [(e, t) for e, t in zip(plant.effects, plant.split(x)[1], strict=True) if which is None or e in which]
