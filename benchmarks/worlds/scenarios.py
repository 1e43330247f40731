"""Scenarios by name: `axle+load`, `axle+snow`, `psi+effect`, ...; every number in them is drawn."""

from collections.abc import Callable, Mapping

import numpy as np
from standin import kinds
from standin.faults import ComShift, Damping, Gain, Rotor, Sag
from standin.outside import Both, LooseLoad, parts
from standin.pushes import Push

from nfc_gym.core.errors import InputError
from nfc_gym.measured.hidden import Coulomb, Delay, Hidden, Kind, Lag, Loss, Payload
from nfc_gym.physics.parameters import ParameterSpace

from .grounds import SURFACES, Ground
from .truth import Truth, psi_off

Rng = np.random.Generator
Part = Callable[[ParameterSpace, Rng], Truth]

BROKEN = {"front_left_wheel_damping": 0.0}  # the paper's: a servo without gain
LOAD = (2.0, 5.0)  # kg of the rock that is not tightly attached
SEVERITY = (0.5, 1.0)  # of psi's anomalies, see `psi_off`
SEVERAL = 3  # effects of the part `effects`
SIZES = (0.7, 1.0)  # of an effect, how far up the logarithm of the range of sizes that its stand-in may hide

_LIMBS = ("right_hip_y", "left_hip_y", "right_knee", "left_knee", "right_ankle_y", "left_ankle_y")
_ARMS = ("right_shoulder1", "left_shoulder1", "right_elbow", "left_elbow")
_MOVED = (*_LIMBS, *_ARMS)


def _one(names: tuple[str, ...], make: Callable[[str, float], Hidden]) -> Callable[[Rng, float], Hidden]:
    return lambda rng, size: make(str(rng.choice(list(names))), size)


HUMANOID: dict[str, Kind] = {
    "loss": Kind(_one(_MOVED, Loss), 0.005, 0.9, "1"),
    "payload": Kind(lambda rng, s: Payload("torso", s, kinds.heading(rng, 0.1, 0.1)), 0.05, 10.0, "kg"),
    "delay": Kind(lambda rng, s: Delay(_LIMBS, s), 0.001, 0.06, "s"),
    "lag": Kind(lambda rng, s: Lag(_LIMBS, s), 0.001, 0.06, "s"),
    "coulomb": Kind(_one(_LIMBS, Coulomb), 0.1, 20.0, "N m"),
    "damping_poly": Kind(_one(_LIMBS, lambda j, s: Damping((j,), s)), 0.02, 10.0, "N m s/rad"),
    "armature": Kind(_one(_LIMBS, lambda j, s: Rotor((j,), s)), 1e-3, 0.5, "kg m^2"),
    "gain": Kind(lambda rng, s: Gain(_LIMBS, 1 + kinds.sign(rng) * s), 0.005, 0.5, "1"),
    "com_shift": Kind(lambda rng, s: ComShift("torso", kinds.heading(rng, s)), 1e-3, 0.1, "m"),
    "external_force": Kind(lambda rng, s: Push("torso", kinds.heading(rng, s)), 0.5, 80.0, "N"),
}
EFFECTS: dict[str, Mapping[str, Kind]] = {
    "jackal": kinds.JACKAL,
    "quadcopter": kinds.QUADCOPTER,
    "quadruped": kinds.QUADRUPED,
    "ant": kinds.ANT,
    "humanoid": HUMANOID,
}


def acts(hidden: Hidden) -> bool:
    """Whether it changes how a robot moves: not a sensor's, nor one that waits for a battery's volts."""
    return all(type(p).read is Hidden.read and not isinstance(p, Sag) for p in parts(hidden))


def effects(robot: str, rng: Rng, count: int) -> Hidden:
    """Effects of different families that the robot's stand-in may hide, at sizes drawn from the larger ones."""
    found: list[Hidden] = []
    for name in rng.permutation(sorted(EFFECTS[robot])):
        kind = EFFECTS[robot][str(name)]
        up = rng.uniform(*SIZES)
        hidden = kind.make(rng, kind.low ** (1 - up) * kind.high**up)
        if acts(hidden):
            found.append(hidden)
        if len(found) == count:
            break
    return found[0] if count == 1 else Both(found)


def _load(space: ParameterSpace, rng: Rng) -> Truth:
    return Truth(hidden=LooseLoad("base", float(rng.uniform(*LOAD)), 0.15, float(rng.uniform(0, np.pi))))


def _on(name: str) -> Part:
    settings = SURFACES[name].settings
    return lambda space, rng: Truth(hidden=Ground.drawn(name, rng), settings=settings)


JACKAL: dict[str, Part] = {
    "axle": lambda space, rng: Truth(psi=BROKEN),
    "load": _load,
    **{name: _on(name) for name in SURFACES},
}
# Table III: the paper's three conditions on Flat and four on Rough.
TABLE_III = {
    "Flat": ("axle", "axle+load", "axle+load+floor"),
    "Rough": ("axle", "axle+snow", "axle+mud", "axle+wet_grass"),
}


def parts_of(robot: str) -> dict[str, Part]:
    """Parts that a scenario of the robot may have."""
    common: dict[str, Part] = {
        "psi": lambda space, rng: Truth(psi=psi_off(space, rng, float(rng.uniform(*SEVERITY)))),
        "effect": lambda space, rng: Truth(hidden=effects(robot, rng, 1)),
        "effects": lambda space, rng: Truth(hidden=effects(robot, rng, SEVERAL)),
        "nominal": lambda space, rng: Truth(),
    }
    return common | (JACKAL if robot == "jackal" else {})


def draw(robot: str, scenario: str, space: ParameterSpace, rng: Rng) -> Truth:
    """The truth of a world.

    Args:
      robot: `jackal`, ...
      scenario: names of parts, joined by +.
      space: the robot's psi.
      rng: each part draws from a generator of its own.

    Raises:
      InputError: no such part.
    """
    known, names = parts_of(robot), scenario.split("+")
    for name in names:
        if name not in known:
            raise InputError(f"scenario {scenario!r}: no {name!r} for the {robot}; there are: {', '.join(known)}")
    truths = [known[name](space, own) for name, own in zip(names, rng.spawn(len(names)), strict=True)]
    psi = {k: v for t in truths for k, v in t.psi.items()}
    settings = {k: v for t in truths for k, v in t.settings.items()}
    hidden = [part for t in truths for part in parts(t.hidden)]
    return Truth(psi, hidden[0] if len(hidden) == 1 else Both(hidden) if hidden else Hidden(), settings)
