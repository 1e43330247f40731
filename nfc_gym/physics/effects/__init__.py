"""The library of effects: every family by name, where a model could have them, and effects from saved values."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from nfc_gym.core import units
from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.air import DragLinear, DragQuadratic
from nfc_gym.physics.effects.backlash import Backlash
from nfc_gym.physics.effects.base import Array, Context, Effect, Forces, Scales
from nfc_gym.physics.effects.command import CommandGain, DeadZone, Offset, Saturation, SupplySag
from nfc_gym.physics.effects.drive import Gain, Loss, TorqueSpeed
from nfc_gym.physics.effects.everywhere import ALL, everywhere
from nfc_gym.physics.effects.friction import Coulomb, DirectionalFriction, LoadFriction, Stribeck
from nfc_gym.physics.effects.generic import GenericMemory, GenericPosition, GenericTime, GenericVelocity
from nfc_gym.physics.effects.generic_ground import GenericGrip, GenericTread
from nfc_gym.physics.effects.generic_inner import GenericInner
from nfc_gym.physics.effects.ground import Compliance, FrictionPatch
from nfc_gym.physics.effects.gust import Gust
from nfc_gym.physics.effects.hysteresis import Hysteresis
from nfc_gym.physics.effects.inertial import ComShift, Inertia, Payload, complete_inertia
from nfc_gym.physics.effects.joint import Armature, Cogging, DampingPoly, SpringOffset
from nfc_gym.physics.effects.law_motion import LawCommand, LawCross, LawPolynomial, LawPower, LawRamp
from nfc_gym.physics.effects.law_place import LawFrictionByPlace, LawHeight, LawPlace
from nfc_gym.physics.effects.law_waves import LawHarmonic, LawWave
from nfc_gym.physics.effects.load import ExternalForce, Slope, Wind
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.places import slid
from nfc_gym.physics.effects.rotor import GroundEffect, RotorDrag
from nfc_gym.physics.effects.sensors import Misalignment, SensorBias, SensorDelay, SensorGain
from nfc_gym.physics.effects.sinkage import Sinkage
from nfc_gym.physics.effects.slip import Slip
from nfc_gym.physics.effects.thermal import Thermal
from nfc_gym.physics.effects.timing import Delay, Lag

__all__ = ["FAMILIES", "Context", "Effect", "Forces", "Param", "Scales", "build", "complete_inertia", "propose"]

_TYPES: tuple[type[Effect], ...] = (
    Coulomb, Stribeck, LoadFriction, DirectionalFriction, DampingPoly, Armature, SpringOffset, Hysteresis, Backlash,
    Cogging, Gain, Loss, CommandGain, Offset, Lag, Delay, DeadZone, Saturation, TorqueSpeed, SupplySag, Thermal,
    Payload, ComShift, Inertia, DragLinear, DragQuadratic, Wind, Gust, RotorDrag, GroundEffect, ExternalForce, Slope,
    Slip, FrictionPatch, Compliance, Sinkage, SensorBias, SensorGain, SensorDelay, Misalignment,
    GenericPosition, GenericVelocity, GenericTime, GenericMemory, GenericGrip, GenericTread, GenericInner,
    LawHarmonic, LawPower, LawPolynomial, LawPlace, LawFrictionByPlace, LawHeight, LawRamp, LawWave, LawCommand,
    LawCross,
)  # fmt: skip

FAMILIES: dict[str, type[Effect]] = {t.family: t for t in _TYPES}


def propose(
    model: mujoco.MjModel, scales: Scales, only: Sequence[str] = (), exclude: Sequence[str] = (), generic: bool = True
) -> list[Effect]:
    """Every effect that the model could have, with sizes that fit the machine.

    Args:
      model: the nominal model.
      scales: typical magnitudes along the logs.
      only: families to propose; empty means all. The generic alternatives stay in either way.
      exclude: families to leave out.
      generic: whether the generic alternatives, which are never claimed by name, are among them.
    """
    named = [f for n, f in FAMILIES.items() if not f.generic and (not only or n in only)]
    generics = [f for f in FAMILIES.values() if f.generic and generic]
    chosen = [f for f in (*named, *generics) if f.family not in exclude]
    proposed: list[Effect] = []
    for family in chosen:
        own = family.propose(model, scales)
        proposed += own or (family.asked(model, scales) if family.family in only else [])
    by_id = {e.id: e for e in proposed}
    for effect in proposed:
        alone = [by_id.get(f"{effect.family}:{name}") for name in effect.where]
        if len(alone) > 1 and None not in alone:
            effect.singles = tuple(e for e in alone if e is not None)
    return proposed


def build(family: str, where: Sequence[str] | str, parameters: Mapping[str, object]) -> tuple[Effect, Array]:
    """An effect and its parameter values (k,) from saved ones, as `effects.yaml` and `report.json` hold them.

    Args:
      family: one of `FAMILIES`.
      where: a name of the model, several, several joined by `+`, or `all` (see `everywhere`).
      parameters: by name, a number or a mapping with `value` and perhaps `unit`; `ms`, `deg` and other scales of the
        parameter's own unit are converted.

    Raises:
      InputError: an unknown family, names of parameters that the family does not have, a unit of something else, a
        place that is named twice, or several places of a family that sits at one alone.
    """
    kind = _family(family)
    places = tuple(where.split("+")) if isinstance(where, str) else tuple(where)
    if kind.lone and len(places) > 1:
        raise InputError(f"{family} sits at one place alone, got: {', '.join(places)}; give an effect for each")
    if twice := [p for p in dict.fromkeys(places) if places.count(p) > 1 and not kind.repeats]:
        raise InputError(f"{family}: {twice[0]} is named more than once; an effect acts at a place or it does not")
    declared = kind.declare(tuple(parameters))
    values, params = [], []
    for p in declared:
        entry = parameters[p.name]
        value, unit = entry, p.unit
        if isinstance(entry, Mapping):
            value, unit = _converted(f"{family}: {p.name}", entry["value"], str(entry.get("unit", p.unit)), p.unit)
        params.append(replace(p, unit=unit))
        values.append(number(value, f"{family}: {p.name}"))
    placed = everywhere(kind) if places == (ALL,) else kind
    return placed(places, params), np.array(values)


def number(value: Any, what: str) -> float:
    """A parameter's value; text that reads like one is one, since YAML takes 1e-3 for text, and a flag is none."""
    if isinstance(value, bool | np.bool_):
        raise InputError(f"{what} is {value!r}; want a number")
    return float(value)


def _converted(what: str, value: Any, unit: str, own: str) -> tuple[Any, str]:
    """A value in a parameter's own unit, of a hinge or of what slides, and that unit."""
    if units.coherent(unit):
        return value, unit
    if not units.known(unit) or units.si_unit(unit) not in (own, slid(own)):
        raise InputError(f"{what} is in {unit!r}; want {own}")
    return float(units.to_si(number(value, what), unit)), units.si_unit(unit)


def _family(name: str) -> type[Effect]:
    if name not in FAMILIES:
        raise InputError(f"no family of effects named {name!r}; there are: {', '.join(FAMILIES)}")
    return FAMILIES[name]
