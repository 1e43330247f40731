"""A cart that balances a pole, and a pendulum with a reaction wheel."""

import mujoco
import numpy as np

from ..channels import controls, joints, speeds
from ..drives import DeadZone, TorqueSpeed
from ..effect import Rng
from ..machine import Case, Format, Machine, Make, Motion, waves
from ..parameters import Parameter


def balancing(rng: Rng) -> Motion:
    """State feedback that follows a goal on the rail, shaken."""
    goal, push, begin = waves(rng, 0.25, 0.1, 0.6), waves(rng, 1.3, 1, 5), rng.normal(0, 0.03, 2)

    def policy(t: float, d: mujoco.MjData) -> list[float]:
        x, angle = d.qpos
        v, rate = d.qvel
        force = 2.2 * (x - goal(t)[0]) + 4 * v + 26 * angle + 5.5 * rate + push(t)[0]
        return [float(np.clip(force, -15, 15))]

    def start(data: mujoco.MjData) -> None:
        data.qpos[:] = begin

    return Motion(policy, start)


CART = Machine(
    "cartpole.xml",
    (
        Parameter("cart_mass", "body_mass", ("cart",), "kg"),
        Parameter("pole_mass", "body_mass", ("pole",), "kg"),
        Parameter("rail_damping", "dof_damping", ("rail",), "N s/m", 0.2),
    ),
    (*joints("rail", 4e-4, "mm"), *joints("pivot", 8e-4, "deg"), *speeds("rail", 0.006, "m/s")),
    controls("belt", "N"), balancing, 100, 5.0, format=Format(uneven=0.3),
)  # fmt: skip


def _dead(rng: Rng) -> Make:
    return lambda size: [DeadZone("belt", size, ["rail"])]


def swinging_up(rng: Rng) -> Motion:
    """Torques of the wheel that reach its limit now and then."""
    slow, fast = waves(rng, 0.4, 0.2, 1.0), waves(rng, 0.12, 1, 4)
    return Motion(lambda t, d: np.clip(slow(t) - 0.0004 * d.qvel[1] + fast(t), -0.25, 0.25))


WHEEL = Machine(
    "reaction_wheel.xml",
    (
        Parameter("rod_mass", "body_mass", ("rod",), "kg"),
        Parameter("wheel_mass", "body_mass", ("flywheel",), "kg"),
        Parameter("pin_damping", "dof_damping", ("pin",), "N m s/rad", 0.25),
    ),
    (*joints("pin", 5e-4, "deg"), *joints("rotor", 2e-3), *speeds("rotor", 0.3, "rpm")),
    controls("motor", "N m"), swinging_up, 100, 5.0, logs=7, format=Format("npz"),
)  # fmt: skip


def _falls(rng: Rng) -> Make:
    return lambda size: [TorqueSpeed("motor", "rotor", 0.25, size)]


CASES = (
    Case(
        "cartpole_dead_zone",
        CART,
        "single",
        _dead,
        what="N of dead zone of the belt",
        sizes=(0.1, 1.2),
        shown=(8, 100),
        cost=130,
    ),
    Case(
        "wheel_torque_speed",
        WHEEL,
        "single",
        _falls,
        what="s/rad by which the motor's limit falls",
        sizes=(2e-4, 1.5e-2),
        shown=(60, 500),
        cost=130,
    ),
)
