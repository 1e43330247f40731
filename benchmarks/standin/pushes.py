"""Forces from outside that a stand-in may hide: wind, drag, a push, and wheels that grip less than they should."""

from collections.abc import Sequence

import mujoco
import numpy as np

from nfc_gym.measured.hidden import Array, Hidden


def velocity_of(data: mujoco.MjData, model: mujoco.MjModel, body: int) -> tuple[Array, Array]:
    """Velocity of a body's centre of mass and its turning rate, both in the world, (3,) each."""
    out = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, out, 0)
    return out[3:], out[:3]


class OnBody(Hidden):
    """What pushes one body where its centre of mass is, or was before something else shifted it."""

    shift = np.zeros(3)  # m, along the body's axes

    def begin(self, model: mujoco.MjModel) -> None:
        self.model, self.body = model, model.body(self.where[0]).id

    def push(self, data: mujoco.MjData) -> None:
        velocity, rate = velocity_of(data, self.model, self.body)
        lever = -data.xmat[self.body].reshape(3, 3) @ self.shift
        force = self.pull(data, velocity + np.cross(rate, lever), rate)
        data.xfrc_applied[self.body, :3] += force
        data.xfrc_applied[self.body, 3:] += np.cross(lever, force)

    def pull(self, data: mujoco.MjData, velocity: Array, rate: Array) -> Array:
        """Force in the world, N."""
        raise NotImplementedError


class Wind(OnBody):
    """Steady wind of (3,) m/s against a linear drag: F = drag (wind - velocity)."""

    family = "wind"

    def __init__(self, body: str, wind: Array, drag: float) -> None:
        values = {f"push_{axis}": float(drag * w) for axis, w in zip("xyz", wind, strict=True)} | {"drag": drag}
        super().__init__((body,), values, f"wind of {np.linalg.norm(wind):.2f} m/s on a drag of {drag:.3g} N s/m")
        self.wind, self.drag = wind, drag

    def pull(self, data: mujoco.MjData, velocity: Array, rate: Array) -> Array:
        return self.drag * (self.wind - velocity)


class Push(OnBody):
    """A constant force of (3,) N."""

    family = "external_force"

    def __init__(self, body: str, force: Array) -> None:
        values = dict(zip("xyz", map(float, force), strict=True))
        super().__init__((body,), values, f"{body} is pushed by {np.linalg.norm(force):.3g} N")
        self.constant = force

    def pull(self, data: mujoco.MjData, velocity: Array, rate: Array) -> Array:
        return self.constant


class Drag(OnBody):
    """Air drag by the speed, or by its square, the same along all axes."""

    def __init__(self, body: str, factor: float, power: int) -> None:
        self.family, unit = ("drag_linear", "N s/m") if power == 1 else ("drag_quadratic", "N s^2/m^2")
        super().__init__((body,), dict.fromkeys("xyz", factor), f"air drag of {factor:.3g} {unit}")
        self.factor, self.power = factor, power

    def pull(self, data: mujoco.MjData, velocity: Array, rate: Array) -> Array:
        return -self.factor * np.linalg.norm(velocity) ** (self.power - 1) * velocity


class RotorDrag(OnBody):
    """Rotors carried through the air: their thrust is dragged back across their axis, in proportion to the speed."""

    family = "rotor_drag"

    def __init__(self, body: str, drag: float) -> None:
        values = {"drag": drag, "inflow": 0.0, "lift": 0.0}
        super().__init__((body,), values, f"rotors drag by {drag:.3g} s/m of their thrust")
        self.drag = drag

    def pull(self, data: mujoco.MjData, velocity: Array, rate: Array) -> Array:
        up = data.xmat[self.body].reshape(3, 3)[:, 2]
        return -self.drag * data.actuator_force.sum() * (velocity - (velocity @ up) * up)


class Slip(Hidden):
    """Wheels lack shares of their sliding friction: `lateral` across, `longitudinal` along their plane."""

    family = "slip"

    def __init__(self, wheels: Sequence[str], radius: float, lateral: float, longitudinal: float) -> None:
        values = {"lateral": lateral, "longitudinal": longitudinal, "creep": 0.0}
        super().__init__(
            ("ground",), values, f"wheels lack {lateral:.1%} of their grip across, {longitudinal:.1%} along"
        )
        self.wheels, self.radius = tuple(wheels), radius

    def begin(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.bodies = [model.joint(w).bodyid[0] for w in self.wheels]
        self.joints = [model.joint(w).id for w in self.wheels]
        self.grip = [float(model.geom(w).friction[0]) for w in self.wheels]
        self.load = model.body_mass.sum() * np.linalg.norm(model.opt.gravity) / len(self.wheels)
        self.up = -model.opt.gravity / np.linalg.norm(model.opt.gravity)

    def push(self, data: mujoco.MjData) -> None:
        for body, joint, grip in zip(self.bodies, self.joints, self.grip, strict=True):
            if not data.xaxis[joint].any():
                continue  # before the first step nothing is known of where the wheels are
            axle = data.xaxis[joint] - (data.xaxis[joint] @ self.up) * self.up
            axle /= np.linalg.norm(axle)
            ahead = np.cross(axle, self.up)
            arm = data.xanchor[joint] - data.xipos[body] - self.radius * self.up
            linear, rate = velocity_of(data, self.model, body)
            patch = linear + np.cross(rate, arm)
            across, along = patch @ axle, patch @ ahead
            missing = self.parameters["lateral"] * across * axle + self.parameters["longitudinal"] * along * ahead
            force = grip * self.load * missing / np.sqrt(across**2 + along**2 + 0.02**2)
            data.xfrc_applied[body] += [*force, *np.cross(arm, force)]
