"""Effects that the library has no law for, or whose family is kept out of the contest; and several effects at once."""

from collections.abc import Sequence

import mujoco
import numpy as np

from nfc_gym.measured.hidden import Array, Hidden

from .faults import ComShift, OnJoint
from .pushes import OnBody


class Both(Hidden):
    """Several effects in one machine."""

    family = "several"

    def __init__(self, parts: Sequence[Hidden]) -> None:
        super().__init__(text=" and ".join(p.text for p in parts))
        self.parts = tuple(parts)
        for push in (p for p in parts if isinstance(p, OnBody)):
            shifts = [p for p in parts if isinstance(p, ComShift) and p.where == push.where]
            push.shift = sum((np.array([p.parameters[a] for a in "xyz"]) for p in shifts), np.zeros(3))

    def shape(self, spec: mujoco.MjSpec) -> None:
        for p in self.parts:
            p.shape(spec)

    def begin(self, model: mujoco.MjModel) -> None:
        for p in self.parts:
            p.begin(model)

    def command(self, u: Array) -> Array:
        for p in self.parts:
            u = p.command(u)
        return u

    def push(self, data: mujoco.MjData) -> None:
        for p in self.parts:
            p.push(data)

    def read(self, columns: dict[str, Array]) -> dict[str, Array]:
        for p in self.parts:
            columns = p.read(columns)
        return columns


def parts(hidden: Hidden) -> tuple[Hidden, ...]:
    """The single effects that a machine hides; none for `none`."""
    if isinstance(hidden, Both):
        return hidden.parts
    return () if hidden.family == "none" else (hidden,)


class Cogging(OnJoint):
    """A torque that repeats `order` times a turn."""

    family = "cogging"

    def __init__(self, joint: str, size: float, order: int, phase: float) -> None:
        super().__init__((joint,), {}, f"{joint} cogs by {size:.3g} N m, {order} times a turn")
        self.size, self.order, self.phase = size, order, phase

    def torque(self, q: Array, v: Array) -> Array:
        return self.size * np.cos(self.order * q + self.phase)


class BoucWen(Hidden):
    """Hysteresis: force -size z, where z follows the joint as a spring would until it yields after `reach`, rad.

    dz/dt = (v - |v| z / 2 - v |z| / 2) / reach. Bouc (1967); Wen, J. Eng. Mech. 102 (1976), with exponent 1.
    """

    family = "hysteresis"

    def __init__(self, joint: str, size: float, reach: float) -> None:
        super().__init__((joint,), {}, f"{joint} has a hysteresis of {size:.3g} N m that yields after {reach:.2g} rad")
        self.size, self.reach = size, reach

    def begin(self, model: mujoco.MjModel) -> None:
        self.dof, self.step, self.z = int(model.joint(self.where[0]).dofadr[0]), model.opt.timestep, 0.0

    def push(self, data: mujoco.MjData) -> None:
        v = float(data.qvel[self.dof])
        self.z += self.step * (v - 0.5 * abs(v) * self.z - 0.5 * v * abs(self.z)) / self.reach
        data.qfrc_applied[self.dof] -= self.size * self.z


class HeightLift(OnBody):
    """Lift that grows with height: F = size (z - 3 m) along the world's z, N."""

    family = "height_lift"

    def __init__(self, body: str, size: float) -> None:
        super().__init__((body,), {}, f"lift grows by {size:.3g} N a metre of height")
        self.size = size

    def pull(self, data: mujoco.MjData, velocity: Array, rate: Array) -> Array:
        return np.array([0.0, 0.0, self.size * (data.qpos[2] - 3.0)])


class Patch(Hidden):
    """Half of the floor has only a share of its friction: what lies beyond a line through the start, towards (2,)."""

    family = "friction_patch"

    def __init__(self, geoms: Sequence[str], base: str, missing: float, towards: Array) -> None:
        super().__init__((base,), {}, f"half of the floor lacks {missing:.1%} of its friction")
        self.geoms, self.missing, self.towards = tuple(geoms), missing, towards

    def begin(self, model: mujoco.MjModel) -> None:
        self.model, self.ids = model, [model.geom(g).id for g in self.geoms]
        self.full = model.geom_friction[self.ids, 0].copy()

    def push(self, data: mujoco.MjData) -> None:
        beyond = data.geom_xpos[self.ids, :2] @ self.towards > 0
        self.model.geom_friction[self.ids, 0] = self.full * (1 - self.missing * beyond)


class BentAxle(Hidden):
    """A wheel whose rim is off the axle's line by `off`, m: it lifts and lowers the machine once a turn."""

    family = "bent_axle"

    def __init__(self, wheel: str, off: float) -> None:
        super().__init__((wheel,), {}, f"{wheel} runs out of true by {1e3 * off:.2f} mm")
        self.off = off

    def shape(self, spec: mujoco.MjSpec) -> None:
        geom = spec.geom(self.where[0])
        geom.pos = np.asarray(geom.pos) + np.array([self.off, 0.0, 0.0])


class LooseLoad(Hidden):
    """A lump that slides to and fro on a body, 10 cm either way, with little friction."""

    family = "loose_load"

    def __init__(self, body: str, mass: float, height: float, heading: float) -> None:
        super().__init__((body,), {}, f"{mass:.3g} kg slide loosely on {body}")
        self.mass, self.height, self.heading = mass, height, heading

    def shape(self, spec: mujoco.MjSpec) -> None:
        lump = spec.body(self.where[0]).add_body(name="loose", pos=[0.0, 0.0, self.height])
        lump.explicitinertial, lump.ipos = True, [0.0, 0.0, 0.0]
        lump.mass, lump.inertia = self.mass, np.full(3, 1e-6)
        lump.add_joint(
            name="loose", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[np.cos(self.heading), np.sin(self.heading), 0.0],
            limited=mujoco.mjtLimited.mjLIMITED_TRUE, range=[-0.1, 0.1], damping=[0.3 * self.mass, 0, 0],
            frictionloss=0.05 * 9.81 * self.mass,
        )  # fmt: skip
        for key in spec.keys:  # the lump's place comes last: it is the body's youngest child
            key.qpos = [*key.qpos, 0.0]
