"""What steps: a hopping leg on a vertical rail, and a planar biped that shuffles in a stride."""

import mujoco
import numpy as np

from ..channels import Channel, controls, joints, speeds
from ..drives import Delay
from ..effect import Array, Effect, Rng
from ..joints import Armature, Coulomb, Spring
from ..machine import Case, Machine, Make, Motion, between, waves
from ..parameters import Parameter


def hopping(rng: Rng) -> Motion:
    """Hip and knee swing together, and each for itself."""
    goal, rate, phase = waves(rng, [0.16, 0.3], 0.4, 2.8), between(rng, 1.2, 2.2), between(rng, 0, 6)

    def policy(t: float, d: mujoco.MjData) -> list[float]:
        hip, knee = goal(t)
        swing = np.sin(2 * np.pi * rate * t + phase)
        return [0.5 + hip + 0.12 * swing, -1.0 + knee - 0.3 * swing]

    def start(data: mujoco.MjData) -> None:
        data.qpos[:] = [-0.03, 0.5, -1.0]

    return Motion(policy, start)


LEG = Machine(
    "leg.xml",
    (
        Parameter("trunk_mass", "body_mass", ("trunk",), "kg", 0.1),
        Parameter("hip_damping", "dof_damping", ("hip",), "N m s/rad", 0.3),
        Parameter("kp_knee", "servo_kp", ("knee_servo",), "N m/rad", 0.1),
    ),
    (
        Channel("joint:rail:pos", ("height",), "mm", 4e-4), *joints("hip knee", 4e-4),
        Channel("joint:rail:vel", ("climb",), "m/s", 0.008), *speeds("hip knee", 0.02),
    ),
    controls("hip_servo knee_servo", "rad"), hopping, 200, 3.0, settle=0.5,
)  # fmt: skip


def _at_a_joint(rng: Rng) -> Make:
    """Dry friction, a rotor or a spring, at the hip or the knee."""
    family, joint = str(rng.choice(["coulomb", "armature", "spring"])), str(rng.choice(["hip", "knee"]))
    rest = {"hip": 0.2, "knee": -0.6}[joint]

    def make(size: float) -> list[Effect]:
        if family == "coulomb":
            return [Coulomb(joint, 0.4 * size)]
        return [Armature(joint, 0.01 * size) if family == "armature" else Spring(joint, 3 * size, rest)]

    return make


SIDES = ("l", "r")
JOINTS = " ".join(f"{s}_{j}" for s in SIDES for j in ("hip", "knee"))
SERVOS = tuple(f"{j}_servo" for j in JOINTS.split())
STRIDE = np.array([-0.55, 0.15, 0.45, 0.3])  # rad: one foot ahead, the other behind


def shuffling(rng: Rng) -> Motion:
    """Goals about a stride."""
    goal = waves(rng, [0.09, 0.12, 0.09, 0.12], 0.5, 3)

    def policy(t: float, d: mujoco.MjData) -> Array:
        return STRIDE + goal(t)

    def start(data: mujoco.MjData) -> None:
        data.qpos[:] = [0, -0.06, 0, *STRIDE]

    return Motion(policy, start)


BIPED = Machine(
    "biped.xml",
    (
        Parameter("torso_mass", "body_mass", ("torso",), "kg", 0.1),
        Parameter("hip_kp", "servo_kp", ("l_hip_servo", "r_hip_servo"), "N m/rad", 0.1),
    ),
    (
        *joints("x z", 5e-4, "m", "q_"), *joints(f"pitch {JOINTS}", 5e-4, "rad", "q_"),
        *speeds("x z", 0.015, "m/s", "v_"), *speeds(f"pitch {JOINTS}", 0.015, "rad/s", "v_"),
    ),
    controls(" ".join(SERVOS), "rad"), shuffling, 100, 2.5, step=0.001, settle=0.5,
)  # fmt: skip


def _late(rng: Rng) -> Make:
    return lambda size: [Delay(SERVOS, size, 0.001, JOINTS.split())]


CASES = (
    Case("leg_none", LEG, "null", cost=70),
    Case(
        "leg_joint",
        LEG,
        "single",
        _at_a_joint,
        what="times 0.4 N m of dry friction, 0.01 kg m^2 of rotor or 3 N m/rad of spring, at hip or knee",
        sizes=(0.1, 3.0),
        shown=(8, 80),
        cost=180,
    ),
    Case(
        "biped_delay",
        BIPED,
        "single",
        _late,
        what="s of delay of all servos",
        sizes=(0.005, 0.04),
        shown=(20, 100),
        cost=160,
    ),
)
