"""Effects of the library beyond those of `kinds`, hidden only where they are asked for: by family, with their sizes.

A plan of its own: a seed draws the same machines from `kinds` as it did before these were there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from nfc_gym.measured import standin
from nfc_gym.measured.hidden import Array, Hidden, Kind
from nfc_gym.measured.standin import Machine

from . import ant, quadcopter, quadruped
from .air import GroundEffect, Gust
from .drives import CommandGain, Thermal
from .faults import Inertia
from .grounds import Compliance, FrictionPatch, Sinkage
from .joints import DirectionalFriction, SolidFriction
from .kinds import RADIUS, Make, Rng, heading, sign
from .play import Backlash
from .sensing import Misalignment, SensorDelay, SensorGain


@dataclass(frozen=True)
class Moved(Kind):
    """An effect that the robot's usual motion hardly shows.

    Attributes:
      log: machine, seconds and seed to columns, of a motion that shows it.
    """

    log: Callable[[Machine, float, int], dict[str, Array]] | None = None


Channel = tuple[str, tuple[str, ...]]  # a channel's name and its columns
_BODY = {
    "pos": ("x", "y", "z"),
    "quat": ("qw", "qx", "qy", "qz"),
    "linvel": ("vx", "vy", "vz"),
    "angvel@body": ("wx", "wy", "wz"),
}


def _place(rng: Rng, names: Sequence[str]) -> str:
    return str(rng.choice(list(names)))


def _of_body(body: str, *quantities: str) -> list[Channel]:
    return [(f"body:{body}:{q}", _BODY[q]) for q in quantities]


def _pick(channels: Sequence[Channel], make: Callable[[str, tuple[str, ...], float], Hidden]) -> Make:
    return lambda rng, s: make(*channels[rng.integers(len(channels))], s)


def _scaled(channels: Sequence[Channel], low: float, high: float) -> Kind:
    make: Make = lambda rng, s: _pick(channels, SensorGain)(rng, 1 + sign(rng) * s)  # noqa: E731
    return Kind(make, low, high, "1")


def _late(channels: Sequence[Channel], high: float) -> Kind:
    return Kind(_pick(channels, SensorDelay), 1e-4, high, "s")


def _turned(body: str) -> Kind:
    def make(rng: Rng, angle: float) -> Hidden:
        return Misalignment(f"body:{body}:quat", _BODY["quat"], heading(rng, angle, angle * rng.uniform(-1, 1)))

    return Kind(make, 1e-4, 0.2, "rad")


def _spread(body: str, high: float) -> Kind:
    """All second moments grow or all shrink, by a third of the most to the most."""

    def make(rng: Rng, s: float) -> Hidden:
        return Inertia(body, (1 + s * rng.uniform(1 / 3, 1, 3)) ** sign(rng))

    return Kind(make, 0.01, high, "1")


def _fading(actuators: Sequence[str], reference: float, high: float) -> Kind:
    make: Make = lambda rng, s: Thermal(_place(rng, actuators), s, float(rng.uniform(0.7, 3.0)), reference)  # noqa: E731
    return Kind(make, 0.01 * high, high, "1")


def _one_way(joints: Sequence[str], low: float, high: float, drag: float) -> Kind:
    """A direction has up to half of the other's friction; each has a drag that is up to `drag` s/rad of its level."""

    def make(rng: Rng, level: float) -> Hidden:
        joint = _place(rng, joints)
        ways = [(s * level, s * level * drag * float(rng.uniform())) for s in (1.0, float(rng.uniform(0, 0.5)))]
        return DirectionalFriction(joint, *(ways if sign(rng) > 0 else ways[::-1]))

    return Kind(make, low, high, "N m")


def _yielding(joints: Sequence[str], high: float) -> Kind:
    make: Make = lambda rng, s: SolidFriction(_place(rng, joints), s, float(rng.uniform(0.05, 0.2)))  # noqa: E731
    return Kind(make, 1e-3 * high, high, "N m")


def _rescaled(actuators: Sequence[str], low: float, high: float) -> Kind:
    make: Make = lambda rng, s: CommandGain([_place(rng, actuators)], 1 + sign(rng) * s)  # noqa: E731
    return Kind(make, low, high, "1")


def _patch(geoms: Sequence[str]) -> Kind:
    def make(rng: Rng, lost: float) -> Hidden:
        return FrictionPatch(geoms, lost, heading(rng, float(rng.uniform(0.2, 0.6)))[:2], rng.uniform(0.4, 0.8, 2))

    return Kind(make, 0.01, 0.95, "1")


def _soft(geoms: Sequence[str], high: float) -> Kind:
    make: Make = lambda rng, s: Compliance(geoms, s, min(s, 1.0) * float(rng.uniform(-0.3, 0.5)))  # noqa: E731
    return Kind(make, 0.01, high, "1")


def _soil(wheels: Sequence[str]) -> Kind:
    make: Make = lambda rng, s: Sinkage(wheels, RADIUS, s, float(rng.uniform(1.0, 1.5)))  # noqa: E731
    return Kind(make, 1e-6, 0.02, "m")


def _gust(body: str) -> Kind:
    def make(rng: Rng, peak: float) -> Hidden:
        start, length = rng.uniform(0.2, 0.8), rng.uniform(0.8, 2.0)
        return Gust(body, heading(rng, peak, peak * rng.uniform(-0.3, 0.3)), float(start), float(length))

    return Kind(make, 0.01, 4.0, "N")


_W, _R = standin.WHEELS, quadcopter.ROTORS
_TURNING = tuple(f"{w}_wheel" for w in _W)
_Q, _A = quadruped.JOINTS, ant.JOINTS
_SWING = tuple(j for j in _Q if not j.endswith("abduction"))
_FEET = tuple(f"{leg}_foot" for leg in quadruped.LEGS)
_ODOMETERS = [(f"joint:{w}_wheel:vel", (f"{w}_speed",)) for w in _W]
_ENCODERS = [(f"joint:{j}:pos", (f"{j}_angle",)) for j in _SWING]

QUADCOPTER: dict[str, Kind] = {
    "thermal": _fading(_R, 2.45, 0.05),
    "inertia": _spread("base", 1.8),
    "gust": _gust("base"),
    "ground_effect": Moved(lambda rng, s: GroundEffect("base", s), 0.01, 0.6, "m", quadcopter.fly_low),
    "sensor_gain": _scaled(_of_body("base", "linvel", "angvel@body"), 1e-3, 0.4),
    "sensor_delay": _late(_of_body("base", *_BODY), 0.1),
    "misalignment": _turned("base"),
}
JACKAL: dict[str, Kind] = {
    "directional_friction": _one_way(_TURNING, 0.02, 5.0, 0.05),
    "backlash": Kind(lambda rng, s: Backlash(_place(rng, _TURNING), s), 1e-3, 0.5, "rad"),
    "command_gain": _rescaled(_W, 5e-4, 0.4),
    "inertia": _spread("base", 1.8),
    "friction_patch": _patch(_TURNING),
    "compliance": _soft(_TURNING, 3.0),
    "sinkage": _soil(_TURNING),
    "sensor_gain": _scaled([*_ODOMETERS, *_of_body("base", "angvel@body")], 1e-3, 0.4),
    "sensor_delay": _late([*_ODOMETERS, *_of_body("base", "pos", "angvel@body")], 0.1),
}
QUADRUPED: dict[str, Kind] = {
    "hysteresis": _yielding(_SWING, 6.0),
    "backlash": Kind(lambda rng, s: Backlash(_place(rng, _SWING), s), 1e-3, 0.3, "rad"),
    "command_gain": _rescaled(_SWING, 5e-4, 0.3),
    "compliance": _soft(_FEET, 8.0),
    "sensor_gain": _scaled(_ENCODERS, 5e-4, 0.3),
}
ANT: dict[str, Kind] = {
    "directional_friction": _one_way(_A, 0.02, 10.0, 0.3),
    "thermal": _fading(_A, 0.5, 0.6),
}
