"""What rolls: a skid-steer rover and a robot of two wheels on casters."""

import mujoco

from ..bodies import Slope
from ..channels import Channel, controls, speeds
from ..drives import Loss
from ..effect import Rng
from ..machine import Case, Machine, Make, Motion, either_way, waves
from ..parameters import Parameter

WHEELS = ("fl", "fr", "rl", "rr")


def driving(rng: Rng) -> Motion:
    """Wheel speeds of a course that bends."""
    goal = waves(rng, [5.0, 3.0], 0.1, 0.9)

    def policy(t: float, d: mujoco.MjData) -> list[float]:
        ahead, turn = goal(t)
        return [ahead - turn, ahead + turn] * 2

    return Motion(policy)


ROVER = Machine(
    "rover.xml",
    (
        Parameter("base_mass", "body_mass", ("base",), "kg", 0.1),
        Parameter("tyre_friction", "geom_friction[0]", tuple(f"{w}_tyre" for w in WHEELS), "1", 0.15),
        Parameter("kv", "servo_kv", tuple(f"{w}_drive" for w in WHEELS), "N m s/rad", 0.12),
    ),
    (
        Channel("body:base:pos", ("x", "y", "z"), "mm", 1.5e-3),
        Channel("body:base:quat", ("qx", "qy", "qz", "qw"), "1", 1.5e-3, order="xyzw"),
        Channel("body:base:angvel@body", ("gx", "gy", "gz"), "rad/s", 0.006),
        *speeds(" ".join(WHEELS), 0.04, prefix="w_"),
    ),
    controls(" ".join(f"{w}_drive" for w in WHEELS), "rad/s"), driving, 50, 4.0, step=0.001, settle=0.6, logs=5,
)  # fmt: skip


def _weak_wheel(rng: Rng) -> Make:
    wheel = str(rng.choice(WHEELS))
    return lambda size: [Loss(f"{wheel}_drive", size, [wheel])]


def rolling(rng: Rng) -> Motion:
    """Torques that follow wheel speeds softly."""
    goal = waves(rng, [3.5, 2.5], 0.15, 1.0)

    def policy(t: float, d: mujoco.MjData) -> list[float]:
        ahead, turn = goal(t)
        return [0.03 * (ahead - turn - d.qvel[6]), 0.03 * (ahead + turn - d.qvel[7])]

    return Motion(policy)


DIFFBOT = Machine(
    "diffbot.xml",
    (
        Parameter("chassis_mass", "body_mass", ("chassis",), "kg", 0.1),
        Parameter("wheel_damping", "dof_damping", ("left", "right"), "N m s/rad", 0.3),
    ),
    (
        Channel("body:chassis:pos", ("x", "y", "z"), "m", 1e-3),
        Channel("body:chassis:quat", ("qw", "qx", "qy", "qz"), "1", 2e-3, order="wxyz"),
        *speeds("left right", 0.05, "rpm", prefix="w_"),
    ),
    controls("ml mr", "N m"), rolling, 60, 4.0, step=1 / 1200, settle=0.5,
)  # fmt: skip


def _leans(rng: Rng) -> Make:
    roll, pitch = either_way(rng, 0.3, 1), either_way(rng, 0.3, 1)
    return lambda size: [Slope(size * roll, size * pitch, "chassis")]


CASES = (
    Case("rover_none", ROVER, "null", cost=140),
    Case(
        "rover_loss",
        ROVER,
        "single",
        _weak_wheel,
        what="of a wheel drive's force lost",
        sizes=(0.1, 0.9),
        shown=(8, 60),
        cost=280,
    ),
    Case(
        "diffbot_slope",
        DIFFBOT,
        "single",
        _leans,
        what="rad times 0.3 to 1 of roll and of pitch of the floor",
        sizes=(0.01, 0.06),
        shown=(6, 40),
        cost=250,
    ),
)
