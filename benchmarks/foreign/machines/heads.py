"""What turns a camera or a foot: a pan-tilt head with an IMU, a direct-drive gimbal, a powered ankle."""

import mujoco
import numpy as np

from ..channels import Channel, Control, controls, joints
from ..drives import Delay
from ..effect import Rng
from ..joints import Cogging, Spring
from ..machine import Case, Format, Machine, Make, Motion, between, waves
from ..parameters import Parameter


def looking(rng: Rng) -> Motion:
    """Goals of both servos."""
    goal = waves(rng, [0.7, 0.4], 0.3, 3)
    return Motion(lambda t, d: goal(t))


PAN_TILT = Machine(
    "pan_tilt.xml",
    (
        Parameter("camera_mass", "body_mass", ("camera",), "kg"),
        Parameter("kp_pan", "servo_kp", ("s_pan",), "N m/rad"),
        Parameter("kp_tilt", "servo_kp", ("s_tilt",), "N m/rad"),
    ),
    (*joints("pan tilt", 5e-4, "deg"), Channel("sensor:gyro", ("gx", "gy", "gz"), "deg/s", 0.01),
     Channel("sensor:acc", ("ax", "ay", "az"), "m/s^2", 0.08)),
    controls("s_pan s_tilt", "deg"), looking, 100, 4.0, settle=0.6, format=Format(clock="us", epoch=1.76e9),
)  # fmt: skip


def _late(rng: Rng) -> Make:
    return lambda size: [Delay(["s_pan", "s_tilt"], size, 0.0005, ["pan", "tilt"])]


def pointing(rng: Rng) -> Motion:
    """Soft position control of three motors."""
    goal = waves(rng, [0.9, 0.6, 0.7], 0.2, 1.5)
    stiff, damped = np.array([0.12, 0.1, 0.1]), np.array([0.005, 0.004, 0.004])
    return Motion(lambda t, d: stiff * (goal(t) - d.qpos) - damped * d.qvel)


GIMBAL = Machine(
    "gimbal.xml",
    (
        Parameter("payload_mass", "body_mass", ("payload",), "kg"),
        Parameter("mid_mass", "body_mass", ("mid",), "kg"),
        Parameter("yaw_damping", "dof_damping", ("yaw",), "N m s/rad", 0.25),
    ),
    joints("yaw roll pitch", 4e-4), controls("m_yaw m_roll m_pitch", "N m"), pointing, 250, 4.0,
    format=Format("npz"),
)  # fmt: skip


def _cogs(rng: Rng) -> Make:
    joint, phase = str(rng.choice(["yaw", "roll", "pitch"])), between(rng, 0, 2 * np.pi)
    order = int(rng.choice([7, 12, 14]))  # pole pairs of such motors
    return lambda size: [Cogging(joint, size, order, phase)]


def treading(rng: Rng) -> Motion:
    """Position control of the knee, goals of the ankle's servo."""
    goal, push = waves(rng, [0.6, 0.45], 0.2, 1.6), waves(rng, 1.5, 1, 4)

    def policy(t: float, d: mujoco.MjData) -> list[float]:
        knee, ankle = goal(t)
        return [(20 * (knee - d.qpos[0]) - 2 * d.qvel[0] + push(t)[0]) / 40, ankle]

    return Motion(policy)


ANKLE = Machine(
    "ankle.xml",
    (
        Parameter("shank_mass", "body_mass", ("shank",), "kg"),
        Parameter("foot_mass", "body_mass", ("foot",), "kg"),
        Parameter("ankle_damping", "dof_damping", ("ankle",), "N m s/rad", 0.25),
    ),
    joints("knee ankle", 4e-4, "deg"),
    (Control("knee_drive", "torque", "N m"), Control("ankle_drive", "goal", "deg")), treading, 150, 5.0,
    step=1 / 1500, settle=0.3,
)  # fmt: skip


def _sprung(rng: Rng) -> Make:
    rest = between(rng, -0.15, 0.15)
    return lambda size: [Spring("ankle", size, rest)]


CASES = (
    Case(
        "pan_tilt_delay",
        PAN_TILT,
        "single",
        _late,
        what="s of delay of both servos",
        sizes=(0.002, 0.04),
        shown=(10, 100),
        cost=110,
    ),
    Case(
        "gimbal_cogging",
        GIMBAL,
        "single",
        _cogs,
        what="N m of cogging of a motor, 7, 12 or 14 times a turn",
        sizes=(2e-4, 1e-2),
        shown=(10, 100),
        cost=90,
    ),
    Case(
        "ankle_spring",
        ANKLE,
        "single",
        _sprung,
        what="N m/rad of a spring at the ankle",
        sizes=(0.3, 8.0),
        shown=(10, 150),
        cost=170,
    ),
)
