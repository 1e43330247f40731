"""Effects on whole bodies and on the world: loads, drag, a floor that leans."""

from collections.abc import Sequence

import mujoco
import numpy as np

from .effect import Array, Effect, Form

GRAVITY = 9.81  # m/s^2


class Payload(Effect):
    """A point mass bolted to a body at a place of the body's frame, m."""

    def __init__(self, body: str, mass: float, at: Sequence[float], places: Sequence[str]) -> None:
        values = {"mass": mass, **dict(zip("xyz", map(float, at), strict=True))}
        place = ", ".join(f"{a:.3f}" for a in at)
        super().__init__((Form("payload", (body,), values),), places, f"{body}: {mass:.3g} kg at ({place}) m")
        self.body, self.mass, self.at = body, mass, np.asarray(at, float)

    def build(self, model: mujoco.MjModel) -> None:
        """Mass, centre and inertia of both together, by the parallel axes."""
        b = model.body(self.body).id
        mass, centre = float(model.body_mass[b]), model.body_ipos[b].copy()
        turn = _matrix(model.body_iquat[b])
        both = (mass * centre + self.mass * self.at) / (mass + self.mass)
        inertia = turn @ np.diag(model.body_inertia[b]) @ turn.T
        inertia += mass * _about(centre - both) + self.mass * _about(self.at - both)
        moments, axes = np.linalg.eigh(inertia)
        if np.linalg.det(axes) < 0:
            axes[:, 0] *= -1
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, axes.ravel())
        model.body_mass[b], model.body_ipos[b] = mass + self.mass, both
        model.body_inertia[b], model.body_iquat[b] = moments, quaternion


def _matrix(quaternion: Array) -> Array:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, quaternion)
    return out.reshape(3, 3)


def _about(arm: Array) -> Array:
    """Inertia (3, 3) of a unit mass at the end of an arm (3,)."""
    return (arm @ arm) * np.eye(3) - np.outer(arm, arm)


class Drag(Effect):
    """Drag on a body along its own axes: -c_i v_i, or -c_i v_i |v|."""

    def __init__(self, body: str, coefficients: Sequence[float], quadratic: bool) -> None:
        values = dict(zip("xyz", map(float, coefficients), strict=True))
        family, unit = ("drag_quadratic", "N s^2/m^2") if quadratic else ("drag_linear", "N s/m")
        sizes = ", ".join(f"{c:.3g}" for c in coefficients)
        super().__init__((Form(family, (body,), values),), (body,), f"{body}: drag of ({sizes}) {unit}")
        self.body, self.coefficients, self.quadratic = body, np.asarray(coefficients, float), quadratic

    def push(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        b, velocity = model.body(self.body).id, np.zeros(6)
        axes = data.xmat[b].reshape(3, 3)
        mujoco.mj_objectVelocity(model, data, int(mujoco.mjtObj.mjOBJ_BODY), b, velocity, 0)
        own = axes.T @ velocity[3:]
        speed = float(np.linalg.norm(own)) if self.quadratic else 1.0
        data.xfrc_applied[b, :3] -= axes @ (self.coefficients * own * speed)


class Slope(Effect):
    """A floor that leans, told as gravity that is tilted against the model's vertical; angles in rad."""

    def __init__(self, roll: float, pitch: float, body: str) -> None:
        self.roll, self.pitch = roll, pitch
        forms = (Form("slope", ("world",), {"roll": roll, "pitch": pitch}),)
        super().__init__(forms, (body, "world"), f"the floor leans by {np.degrees(np.hypot(roll, pitch)):.2f} degrees")

    def build(self, model: mujoco.MjModel) -> None:
        lean = np.hypot(self.roll, self.pitch)
        ahead, aside = -np.sin(lean) * self.pitch / lean, np.sin(lean) * self.roll / lean
        model.opt.gravity[:] = GRAVITY * np.array([ahead, aside, -np.cos(lean)])
