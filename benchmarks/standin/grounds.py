"""Grounds that a stand-in may hide: slippery in one place, soft, or so soft that wheels sink in."""

from collections.abc import Sequence

import mujoco
import numpy as np

from nfc_gym.measured.hidden import Array, Hidden

from .pushes import velocity_of

EDGE = 0.2  # of a patch's radius: over so much its friction rises to that of the rest


class FrictionPatch(Hidden):
    """An ellipse on the floor, at (2,) m with radii (2,) m, lacks a share of the friction that the rest has."""

    family = "friction_patch"

    def __init__(self, geoms: Sequence[str], lost: float, at: Array, radii: Array) -> None:
        values = {"lost": lost, "x": float(at[0]), "y": float(at[1])}
        values |= {"radius_x": float(radii[0]), "radius_y": float(radii[1])}
        text = f"within {radii[0]:.2f} by {radii[1]:.2f} m of ({at[0]:.2f}, {at[1]:.2f}) the floor"
        super().__init__(("ground",), values, f"{text} lacks {lost:.1%} of its friction")
        self.geoms, self.at, self.radii = tuple(geoms), at, radii

    def begin(self, model: mujoco.MjModel) -> None:
        self.model, self.ids = model, [model.geom(g).id for g in self.geoms]
        self.full = model.geom_friction[self.ids, 0].copy()

    def push(self, data: mujoco.MjData) -> None:
        away = np.hypot(*((data.geom_xpos[self.ids, :2] - self.at) / self.radii).T)
        inside = np.clip((1 - away) / EDGE + 0.5, 0, 1)
        self.model.geom_friction[self.ids, 0] = self.full * (1 - self.parameters["lost"] * inside)


class Compliance(Hidden):
    """Ground on which contacts spring 1 / (1 + softness) as fast, with 1 + damping times the damping ratio."""

    family = "compliance"

    def __init__(self, geoms: Sequence[str], softness: float, damping: float) -> None:
        values = {"softness": softness, "damping": damping}
        super().__init__(("ground",), values, f"the ground is softer by {softness:.3g}, damped by {damping:.2g} more")
        self.geoms = tuple(geoms)

    def shape(self, spec: mujoco.MjSpec) -> None:
        slower, ratio = 1 + self.parameters["softness"], 1 + self.parameters["damping"]
        for name in self.geoms:
            first, second = spec.geom(name).solref
            if first < 0:  # minus a stiffness and a damping for a unit mass
                stiffness, damping = -first, -second
                frequency, zeta = np.sqrt(stiffness), damping / (2 * np.sqrt(stiffness))
                frequency, zeta = frequency / slower, zeta * ratio
                spec.geom(name).solref = [-(frequency**2), -2 * zeta * frequency]
            else:  # 1 / (frequency zeta), and zeta
                frequency = 1 / (first * second) / slower
                spec.geom(name).solref = [1 / (frequency * second * ratio), second * ratio]


class Sinkage(Hidden):
    """Soil: it bears wheels a depth below where it is seen, and each wheel is held back by a share of its load.

    The share is (3 / 4) sqrt(depth / diameter) of a rigid wheel (Bekker, Introduction to Terrain-Vehicle Systems,
    1969), times what a bow wave adds.
    """

    family = "sinkage"

    def __init__(self, wheels: Sequence[str], radius: float, depth: float, bow: float) -> None:
        share = bow * 0.75 * np.sqrt(depth / (2 * radius))
        text = f"wheels sink by {1e3 * depth:.2f} mm and are held back by {share:.3g} of their load"
        super().__init__(("ground",), {"depth": depth, "resistance": share}, text)
        self.wheels = tuple(wheels)

    def shape(self, spec: mujoco.MjSpec) -> None:
        ground = spec.geom("ground")
        ground.pos = np.asarray(ground.pos) - [0.0, 0.0, self.parameters["depth"]]

    def begin(self, model: mujoco.MjModel) -> None:
        self.model, self.bodies = model, [int(model.joint(w).bodyid[0]) for w in self.wheels]
        self.held = self.parameters["resistance"] * model.body_mass.sum() * 9.81 / len(self.bodies)

    def push(self, data: mujoco.MjData) -> None:
        for body in self.bodies:
            velocity = velocity_of(data, self.model, body)[0][:2]
            data.xfrc_applied[body, :2] -= self.held * velocity / np.hypot(np.linalg.norm(velocity), 0.02)
