"""Grounds that a rover meets outdoors: less grip, wheels that sink in, and ground that holds them back."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np

from nfc_gym.measured.hidden import Hidden

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
RADIUS = 0.098  # m, of the Jackal's wheels
WEIGHT = 17.0 * 9.81 / 4  # N on each
TYRE = 0.005  # m that a tyre itself gives under it
IMPEDANCE = 0.5  # of the contact: a soft one; a hard one would lift wheels that slide sideways


@dataclass(frozen=True)
class Surface:
    """What a ground is like, as (low, high) of what is drawn.

    Attributes:
      friction: between tyre and ground.
      sinkage: m that a wheel at rest sinks in, beyond the tyre's own 5 mm.
      resistance: force that holds a rolling wheel back, as a share of the weight on it.
      settings: of the Rough environment: its roughness.
    """

    friction: tuple[float, float]
    sinkage: tuple[float, float] = (0.0, 0.0)
    resistance: tuple[float, float] = (0.0, 0.0)
    settings: Mapping[str, object] = field(default_factory=dict)


# Assumptions, of the order that textbooks on vehicles off the road give: friction of tyres 0.2 to 0.3 on hard snow and
# 0.5 on wet earth; rolling resistance 0.05 on earth roads, 0.1 to 0.35 on fields. The paper infers 0.4 on snow.
SURFACES = {
    "floor": Surface((0.3, 1.3)),  # of a laboratory: polished concrete to rubber mats
    "snow": Surface((0.25, 0.45), (0.01, 0.03), (0.06, 0.15), {"terrain_kind": "rough", "difficulty": 0.5}),
    "mud": Surface((0.3, 0.5), (0.02, 0.04), (0.1, 0.25), {"terrain_kind": "rough", "difficulty": 0.7}),
    "wet_grass": Surface((0.35, 0.55), (0.003, 0.01), (0.05, 0.1), {"terrain_kind": "rough", "difficulty": 0.9}),
}  # fmt: skip


class Ground(Hidden):
    """Ground under the Jackal's wheels.

    Args:
      name: of what it is.
      friction, sinkage, resistance: see `Surface`.

    A wheel sinks until the ground bears it: a spring that gives by `sinkage` under the wheel's weight, critically
    damped. Resistance is a torque on the wheel, of that force times its radius, so that a wheel without a drive stands.
    """

    family = "ground"

    def __init__(self, name: str, friction: float, sinkage: float, resistance: float) -> None:
        values = {"friction": friction, "sinkage": sinkage, "resistance": resistance}
        text = f"{name}: friction {friction:.2f}, wheels sink in by {1e3 * sinkage:.0f} mm, {resistance:.1%} hold back"
        super().__init__(("ground",), values, text)

    @classmethod
    def drawn(cls, name: str, rng: np.random.Generator) -> "Ground":
        """One of its kind."""
        s = SURFACES[name]
        friction, sinkage, resistance = (float(rng.uniform(*r)) for r in (s.friction, s.sinkage, s.resistance))
        return cls(name, friction, sinkage, resistance)

    def shape(self, spec: mujoco.MjSpec) -> None:
        p, built = self.parameters, spec.copy().compile()
        for wheel in WHEELS:
            geom, joint = spec.geom(f"{wheel}_wheel"), spec.joint(f"{wheel}_wheel")
            geom.friction[0] = p["friction"]
            joint.frictionloss = joint.frictionloss + p["resistance"] * WEIGHT * RADIUS
            if p["sinkage"] > 0:
                # At rest a weight W sinks by r where k r = W A (1 - d) / d, for an impedance d and an inverse mass A
                # as seen by the contact; it is damped critically where d b = 2 sqrt(d k). MuJoCo divides both
                # numbers of solref by d.
                d, light = IMPEDANCE, float(built.body_invweight0[built.body(f"{wheel}_wheel").id, 0])
                k = (1 - d) / d * WEIGHT * light / (p["sinkage"] + TYRE)
                geom.solref = [-k * d, -2 * np.sqrt(k / d) * d]
                geom.solimp = [d, d, 0.001, 0.5, 2]
