"""Residual dynamics as physics: effects that the model may lack, each of an unknown size, beside psi.

A delay, a drive's lag or a dry bearing is no constant step away from the nominal model: it depends on what was
commanded before and on how the robot moves. `Structure` names the effects that a robot may lack and gives their sizes
coordinates z in which the prior is standard normal, so that whatever infers psi in such coordinates infers them too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects import Effect
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.residuals import Given, candidates

Array = NDArray[np.float64]
# Families that are asked for, at which of their places: everything of its kind together, several like places together
# (all knees), or each place alone. They are those of one size, or of one vector, whose absence is an inner or outer
# point of a line: a Gaussian belief fits them.
TOGETHER = ("delay", "lag")
ALIKE = ("gain", "saturation")
ALONE = ("coulomb", "gain", "armature")
ON_THE_BASE = ("external_force", "com_shift", "drag_linear")
_REACH = 3.0  # realistic sizes of the library at z = 1, of what has one sign
_REACH_BOTH = 2.0  # the same of what has both
_ABSENT, _SHARP = 0.5, 4.0  # z below which an effect with one sign is as good as absent, and how sharp that bend is


@dataclass(frozen=True)
class Size:
    """A parameter of an effect as a function of its coordinate z.

    Attributes:
      null: where the effect is absent.
      scale: from there, at z about 1.
      low, high: the parameter's bounds.
    """

    null: float
    scale: float
    low: float
    high: float

    def value(self, z: Array) -> Array:
        """In the parameter's own unit; a coordinate without a sign bends towards the absent effect at 1/2."""
        if self.low < self.null < self.high:
            return np.clip(self.null + self.scale * z, self.low, self.high)
        bent = np.logaddexp(0.0, _SHARP * (z - _ABSENT)) / _SHARP
        return np.clip(self.null + self.scale * bent, self.low, self.high)


@dataclass(frozen=True)
class Structure:
    """Effects of unknown sizes.

    Attributes:
      effects: bound to the robot's model, in the order in which they act.
      sizes: of their parameters, those of an effect next to each other.
    """

    effects: tuple[Effect, ...] = ()
    sizes: tuple[tuple[Size, ...], ...] = ()

    def __len__(self) -> int:
        """How many sizes there are."""
        return sum(map(len, self.sizes))

    def values(self, z: Array) -> list[Array]:
        """(n, k) values of each effect from coordinates (n, `len(self)`)."""
        columns = iter(z.T)
        return [np.stack([size.value(next(columns)) for size in sizes], -1) for sizes in self.sizes]

    def given(self, z: Array) -> list[Given]:
        """The effects in n rows of a batch, with the sizes of coordinates (n, `len(self)`)."""
        rows = slice(0, len(z))
        return [Given(effect, rows, theta) for effect, theta in zip(self.effects, self.values(z), strict=True)]


def structure_of(machine: Machine, families: Sequence[str] = ()) -> Structure:
    """What a robot may lack.

    Args:
      machine: the robot.
      families: of those that are asked for; empty means all.

    Raises:
      InputError: a family that is not asked for.
    """
    known = tuple(dict.fromkeys((*TOGETHER, *ALIKE, *ALONE, *ON_THE_BASE)))
    odd = [f for f in families if f not in known]
    if odd:
        raise InputError(f"structure: no family {odd[0]!r}; want some of: {', '.join(known)}")
    base = machine.model.body(1).name
    found = [e for e in candidates(machine) if e.family in (families or known) and _asked(e, machine, base)]
    for effect in found:
        effect.bind(machine.model)
    return Structure(tuple(found), tuple(tuple(map(_size, range(len(e.params)), [e] * len(e.params))) for e in found))


def _asked(effect: Effect, machine: Machine, base: str) -> bool:
    if effect.family in ON_THE_BASE:
        return effect.where == (base,)
    if effect.family in TOGETHER:
        return len(effect.where) == machine.model.nu
    driven = {machine.model.joint(int(j)).name for j in machine.model.actuator_trnid[:, 0] if j >= 0}
    alone = len(effect.where) == 1 and (effect.family not in ("coulomb", "armature") or effect.where[0] in driven)
    return (effect.family in ALIKE and len(effect.where) > 1) or (effect.family in ALONE and alone)


def _size(i: int, effect: Effect) -> Size:
    p = effect.params[i]
    largest = max(abs(probe - p.null) for probe in p.probes)
    both = p.low < p.null < p.high
    return Size(p.null, (_REACH_BOTH if both else _REACH) * largest, p.low, p.high)


def names(structure: Structure) -> tuple[str, ...]:
    """Of the sizes: `family:place.parameter`."""
    return tuple(f"{e.id}.{p.name}" for e in structure.effects for p in e.params)


def kept(structure: Structure, values: Sequence[Array], least: float) -> Mapping[int, Array]:
    """Effects whose sizes (n, k) are not negligible: index -> values; `least` is a share of each size's scale."""
    out = {}
    for i, (sizes, theta) in enumerate(zip(structure.sizes, values, strict=True)):
        off = np.abs(theta - [s.null for s in sizes]).mean(0) / [s.scale for s in sizes]
        if (off > least).any():
            out[i] = theta
    return out
