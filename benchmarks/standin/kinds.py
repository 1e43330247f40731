"""What each stand-in may hide: effects by family, with the range of sizes that is searched for a wanted X / X_null."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nfc_gym.measured import standin
from nfc_gym.measured.hidden import Array, Coulomb, Delay, Hidden, Kind, Lag, Loss, Payload, Slope

from . import ant, outside, quadcopter, quadruped
from .faults import (
    Bias,
    ComShift,
    Damping,
    DeadZone,
    Gain,
    Offset,
    Rotor,
    Sag,
    Saturation,
    Spring,
    Stribeck,
    Weak,
)
from .pushes import Drag, Push, RotorDrag, Slip, Wind

Rng = np.random.Generator
Make = Callable[[Rng, float], Hidden]
RADIUS = 0.098  # m, of the Jackal's wheels


@dataclass(frozen=True)
class Outside(Kind):
    """An effect that the library cannot name.

    Attributes:
      exclude: families left out of the contest, because they are its own law.
      near: families that are truly part of it, so that to name them beside a rest is no false claim.
      coordinate: makes, of the drawn effect, the place where the rest must be said to sit.
    """

    exclude: tuple[str, ...] = ()
    near: tuple[str, ...] = ()
    coordinate: Callable[[Hidden], str] = lambda hidden: f"body:{hidden.where[0]}"


def _on_joint(hidden: Hidden) -> str:
    return f"joint:{hidden.where[0]}"


def heading(rng: Rng, size: float = 1.0, up: float = 0.0) -> Array:
    """A horizontal vector (3,) of that size, and its height."""
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([size * np.cos(angle), size * np.sin(angle), up])


def sign(rng: Rng) -> float:
    """-1 or 1."""
    return float(rng.choice([-1.0, 1.0]))


def _one(names: Sequence[str], make: Callable[[str, float], Hidden]) -> Make:
    return lambda rng, s: make(str(rng.choice(list(names))), s)


def _carried(body: str, x: float, y: float, z: float) -> Make:
    def make(rng: Rng, mass: float) -> Hidden:
        angle = rng.uniform(0, 2 * np.pi)
        return Payload(body, mass, np.array([x * np.cos(angle), y * np.sin(angle), z]))

    return make


def _leaning(rng: Rng, angle: float) -> Hidden:
    roll, pitch, _ = heading(rng, angle)
    return Slope(float(roll), float(pitch))


def _stribeck(names: Sequence[str], speed: float) -> Make:
    return _one(names, lambda joint, s: Stribeck(joint, s, s, speed))


def _spring(rests: dict[str, float]) -> Make:
    """A spring whose rest is a third of a radian off the joint's usual angle, by the last part of its name."""

    def make(rng: Rng, stiffness: float) -> Hidden:
        joint = str(rng.choice(list(rests)))
        return Spring((joint,), stiffness, rests[joint] + sign(rng) / 3)

    return make


def _encoder(names: Sequence[str]) -> Make:
    return lambda rng, s: Bias(
        f"joint:{(j := str(rng.choice(list(names))))}:pos", [f"{j}_angle"], np.array([sign(rng) * s])
    )


def _gyro(body: str) -> Make:
    return lambda rng, s: Bias(f"body:{body}:angvel@body", ["wx", "wy", "wz"], heading(rng, s, s * rng.uniform(-1, 1)))


def _cogs(names: Sequence[str], orders: Sequence[int]) -> Outside:
    def make(rng: Rng, size: float) -> Hidden:
        joint, order = str(rng.choice(list(names))), int(rng.choice(list(orders)))
        return outside.Cogging(joint, size, order, float(rng.uniform(0, 2 * np.pi)))

    return Outside(make, 0.01, 20.0, "N m", ("cogging",), coordinate=_on_joint)


def _hysteresis(names: Sequence[str], reach: float, high: float) -> Outside:
    make = _one(names, lambda joint, s: outside.BoucWen(joint, s, reach))
    return Outside(make, 1e-3 * high, high, "N m", ("hysteresis",), coordinate=_on_joint)


def _patch(geoms: Sequence[str], base: str) -> Outside:
    make: Make = lambda rng, s: outside.Patch(geoms, base, s, heading(rng)[:2])  # noqa: E731
    return Outside(make, 0.02, 0.95, "1", ("friction_patch",))


def _loose(body: str, height: float, low: float, high: float) -> Outside:
    make: Make = lambda rng, s: outside.LooseLoad(body, s, height, float(rng.uniform(0, np.pi)))  # noqa: E731
    return Outside(make, low, high, "kg", near=("payload",))


_W, _R = standin.WHEELS, quadcopter.ROTORS
_TURNING = tuple(f"{w}_wheel" for w in _W)
_Q, _A = quadruped.JOINTS, ant.JOINTS
_KNEES = tuple(j for j in _Q if j.endswith("knee"))
_SWING = tuple(j for j in _Q if not j.endswith("abduction"))  # an abduction hardly turns: nothing shows its own laws
_HIPS = tuple(j for j in _A if j.endswith("hip"))
_ANKLES = tuple(j for j in _A if j.endswith("ankle"))

JACKAL: dict[str, Kind] = {
    "loss": Kind(_one(_W, Loss), 0.01, 0.98, "1"),
    "payload": Kind(_carried("base", 0.17, 0.12, 0.15), 0.05, 12.0, "kg"),
    "delay": Kind(lambda rng, s: Delay(_W, s), 0.001, 0.1, "s"),
    "lag": Kind(lambda rng, s: Lag(_W, s), 0.001, 0.1, "s"),
    "coulomb": Kind(_one(_TURNING, Coulomb), 0.02, 5.0, "N m"),
    "slope": Kind(_leaning, 0.001, 0.2, "rad"),
    "damping_poly": Kind(_one(_TURNING, lambda j, s: Damping((j,), s)), 1e-3, 3.0, "N m s/rad"),
    "armature": Kind(_one(_TURNING, lambda j, s: Rotor((j,), s)), 1e-3, 0.07, "kg m^2"),
    "stribeck": Kind(_stribeck(_TURNING, 1.0), 0.02, 4.0, "N m"),
    "dead_zone": Kind(lambda rng, s: DeadZone(_W, s), 0.02, 4.0, "rad/s"),
    "sensor_bias": Kind(_gyro("base"), 0.001, 0.5, "rad/s"),
    "external_force": Kind(lambda rng, s: Push("base", heading(rng, s)), 0.05, 60.0, "N"),
    "slip": Kind(lambda rng, s: Slip(_TURNING, RADIUS, s, s / 2), 0.01, 0.95, "1"),
}
QUADCOPTER: dict[str, Kind] = {
    "loss": Kind(_one(_R, Loss), 0.002, 0.3, "1"),
    "payload": Kind(_carried("base", 0.06, 0.06, -0.05), 0.002, 0.25, "kg"),
    "wind": Kind(lambda rng, s: Wind("base", heading(rng, s), 0.12), 0.02, 8.0, "m/s"),
    "drag_linear": Kind(lambda rng, s: Drag("base", s, 1), 0.005, 1.0, "N s/m"),
    "drag_quadratic": Kind(lambda rng, s: Drag("base", s, 2), 0.005, 1.0, "N s^2/m^2"),
    "rotor_drag": Kind(lambda rng, s: RotorDrag("base", s), 5e-4, 0.1, "s/m"),
    "delay": Kind(lambda rng, s: Delay(_R, s), 0.001, 0.02, "s"),
    "lag": Kind(lambda rng, s: Lag(_R, s), 0.001, 0.03, "s"),
    "supply_sag": Kind(lambda rng, s: Sag(_R, s), 0.02, 3.0, "1"),
    "gain": Kind(lambda rng, s: Gain(_R, 1 + sign(rng) * s), 0.002, 0.25, "1"),
    "offset": Kind(lambda rng, s: Offset(str(rng.choice(_R)), sign(rng) * s), 0.003, 0.6, "N"),
    "sensor_bias": Kind(_gyro("base"), 0.001, 0.5, "rad/s"),
    "com_shift": Kind(lambda rng, s: ComShift("base", heading(rng, s)), 1e-4, 0.03, "m"),
}
QUADRUPED: dict[str, Kind] = {
    "loss": Kind(_one(_SWING, Loss), 0.005, 0.9, "1"),
    "payload": Kind(_carried("base", 0.12, 0.06, 0.08), 0.02, 5.0, "kg"),
    "delay": Kind(lambda rng, s: Delay(_Q, s), 0.001, 0.06, "s"),
    "lag": Kind(lambda rng, s: Lag(_Q, s), 0.001, 0.06, "s"),
    "coulomb": Kind(_one(_SWING, Coulomb), 0.02, 5.0, "N m"),
    "slope": Kind(_leaning, 0.002, 0.2, "rad"),
    "damping_poly": Kind(lambda rng, s: Damping(_KNEES, s), 0.005, 1.5, "N m s/rad"),
    "armature": Kind(lambda rng, s: Rotor(_KNEES, s), 2e-4, 0.05, "kg m^2"),
    "spring_offset": Kind(_spring(dict.fromkeys(_KNEES, -1.7)), 0.1, 20.0, "N m/rad"),
    "offset": Kind(lambda rng, s: Offset(str(rng.choice(_SWING)), sign(rng) * s), 0.001, 0.2, "rad"),
    "gain": Kind(lambda rng, s: Gain(_KNEES, 1 + sign(rng) * s), 0.005, 0.5, "1"),
    "sensor_bias": Kind(_encoder(_SWING), 5e-4, 0.1, "rad"),
    "saturation": Kind(lambda rng, s: Weak(_KNEES, 1 / s), 0.05, 0.6, "1/(N m)"),
    "com_shift": Kind(lambda rng, s: ComShift("base", heading(rng, s)), 5e-4, 0.1, "m"),
}
ANT: dict[str, Kind] = {
    "loss": Kind(_one(_A, Loss), 0.005, 0.95, "1"),
    "payload": Kind(_carried("torso", 0.18, 0.18, 0.1), 0.02, 5.0, "kg"),
    "delay": Kind(lambda rng, s: Delay(_A, s), 0.001, 0.1, "s"),
    "lag": Kind(lambda rng, s: Lag(_A, s), 0.001, 0.1, "s"),
    "coulomb": Kind(_one(_A, Coulomb), 0.02, 10.0, "N m"),
    "slope": Kind(_leaning, 0.002, 0.2, "rad"),
    "damping_poly": Kind(_one(_A, lambda j, s: Damping((j,), s)), 0.01, 6.0, "N m s/rad"),
    "armature": Kind(_one(_A, lambda j, s: Rotor((j,), s)), 1e-3, 0.5, "kg m^2"),
    "spring_offset": Kind(_spring(dict.fromkeys(_HIPS, 0.0)), 0.1, 40.0, "N m/rad"),
    "stribeck": Kind(_stribeck(_HIPS, 0.5), 0.02, 8.0, "N m"),
    "dead_zone": Kind(lambda rng, s: DeadZone(_A, s), 0.002, 0.4, "1"),
    "saturation": Kind(lambda rng, s: Saturation(_ANKLES, s), 0.1, 0.9, "1"),
    "gain": Kind(lambda rng, s: Gain(_ANKLES, 1 + sign(rng) * s), 0.005, 0.5, "1"),
    "sensor_bias": Kind(_encoder(_A), 5e-4, 0.1, "rad"),
}
JACKAL_OUTSIDE = {
    "cogging": _cogs(_TURNING, (3, 6)),
    "hysteresis": _hysteresis(_TURNING, 1.0, 5.0),
    "friction_patch": _patch(_TURNING, "base"),
    "bent_axle": Outside(_one(_TURNING, outside.BentAxle), 1e-4, 0.02, "m", ("cogging",), coordinate=_on_joint),
    "loose_load": _loose("base", 0.15, 0.05, 8.0),
}
QUADCOPTER_OUTSIDE = {
    "height_lift": Outside(
        lambda rng, s: outside.HeightLift("base", sign(rng) * s), 0.01, 4.0, "N/m", ("ground_effect",)
    ),
    "hysteresis": _hysteresis([f"{r}_mount_{a}" for r in _R for a in "xy"], 0.02, 0.5),
    "loose_load": _loose("base", -0.05, 0.002, 0.2),
}
QUADRUPED_OUTSIDE = {
    "cogging": _cogs(_SWING, (6, 12)),
    "hysteresis": _hysteresis(_SWING, 0.2, 6.0),
    "friction_patch": _patch([f"{leg}_foot" for leg in quadruped.LEGS], "base"),
    "loose_load": _loose("base", 0.08, 0.05, 5.0),
}
ANT_OUTSIDE = {
    "cogging": _cogs(_A, (6, 12)),
    "hysteresis": _hysteresis(_A, 0.2, 15.0),
    "friction_patch": _patch([f"{leg}_foot" for leg in ant.LEGS], "torso"),
    "loose_load": _loose("torso", 0.15, 0.05, 5.0),
}
