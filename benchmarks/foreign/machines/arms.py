"""Arms: two links with motors, six joints of servos, three links, a geared one, and a URDF leg on a test stand."""

import mujoco
import numpy as np

from ..bodies import Payload
from ..channels import Channel, Control, controls, joints, speeds
from ..drives import Delay
from ..effect import Effect, Rng
from ..joints import Bias, Coulomb, LoadFriction
from ..machine import Case, Format, Machine, Make, Motion, between, either_way, waves
from ..outside import Loom
from ..parameters import Parameter

HALF_MS = 0.0005  # s, the truth's step of the machines here but for the servo arm

# ---- two links ------------------------------------------------------------------------------------------------------

TWO_LINKS = (
    Parameter("upper_mass", "body_mass", ("upper",), "kg"),
    Parameter("fore_mass", "body_mass", ("fore",), "kg"),
    Parameter("sh_damping", "dof_damping", ("sh",), "N m s/rad", 0.2),
    Parameter("el_damping", "dof_damping", ("el",), "N m s/rad", 0.2),
)
TORQUES = (Control("m_sh", "tau_sh", "N m"), Control("m_el", "tau_el", "N m"))
COUNT = 2 * np.pi / 8192  # rad, of the encoders


def two_links(rng: Rng) -> Motion:
    """Soft position control to smooth goals, and torques on top."""
    goal, push = waves(rng, [0.9, 1.0], 0.2, 1.4), waves(rng, [0.8, 0.4], 1, 6)
    return Motion(lambda t, d: np.array([10, 5]) * (goal(t) - d.qpos) - np.array([0.6, 0.25]) * d.qvel + push(t))


ENCODERS = tuple(
    Channel(f"joint:{j}:pos", (j,), "deg", COUNT / np.sqrt(12), count=COUNT) for j in ("sh", "el")
)  # fmt: skip
COUNTED = Machine(
    "arm2.xml", TWO_LINKS, ENCODERS, TORQUES, two_links, 200, 5.0,
    format=Format(separator=";", jitter=1e-4),
)  # fmt: skip
TACHO = Machine(
    "arm2.xml", TWO_LINKS, (*joints("sh el", 3e-4, "deg"), *speeds("sh el", 0.01)), TORQUES, two_links, 200, 5.0,
    format=Format("npz"),
)  # fmt: skip


def _dry_and_late(rng: Rng) -> Make:
    friction, late = between(rng, 0.05, 0.15), between(rng, 0.008, 0.03)

    def make(size: float) -> list[Effect]:
        return [Coulomb("el", size * friction), Delay(["m_sh"], size * late, HALF_MS, ["sh"])]

    return make


def _bias(rng: Rng) -> Make:
    side = either_way(rng, 1, 1)
    return lambda size: [Bias("joint:sh:pos", side * size)]


# ---- six servos -----------------------------------------------------------------------------------------------------


def six_joints(rng: Rng) -> Motion:
    """Goals of six servos, from where the goals begin."""
    goal = waves(rng, [0.5, 0.35, 0.4, 0.7, 0.6, 0.8], 0.15, 1.3)

    def start(data: mujoco.MjData) -> None:
        data.qpos[:] = goal(-0.5)

    return Motion(lambda t, d: goal(t), start)


SERVO_ARM = Machine(
    "arm6.xml",
    (
        Parameter("upper_arm", "body_mass", ("link2",), "kg", 0.12),
        Parameter("forearm", "body_mass", ("link4",), "kg", 0.12),
        Parameter("kp_elbow", "servo_kp", ("a3",), "N m/rad", 0.12),
        Parameter("wrist_damping", "dof_damping", ("j5",), "N m s/rad", 0.3),
    ),
    joints("j1 j2 j3 j4 j5 j6", 2e-4, "deg"), controls("a1 a2 a3 a4 a5 a6", "deg"), six_joints, 100, 5.0,
    step=0.001, settle=0.5, logs=5, format=Format(separator="\t"),
)  # fmt: skip


def _tool(rng: Rng) -> Make:
    height = between(rng, -0.03, 0.03)
    return lambda size: [Payload("link6", size, (0.08, 0.0, height), ["j6", "j5", "link6"])]


# ---- three links with a cable loom ----------------------------------------------------------------------------------


def three_links(rng: Rng) -> Motion:
    """As the two links."""
    goal, push = waves(rng, [0.6, 0.8, 0.9], 0.2, 1.3), waves(rng, [1.5, 0.8, 0.3], 1, 5)
    stiff, damped = np.array([30, 14, 5]), np.array([2.5, 1.0, 0.3])
    return Motion(lambda t, d: stiff * (goal(t) - d.qpos) - damped * d.qvel + push(t))


LOOMED = Machine(
    "arm3.xml",
    (
        Parameter("b_mass", "body_mass", ("b",), "kg"),
        Parameter("c_mass", "body_mass", ("c",), "kg"),
        Parameter("q1_damping", "dof_damping", ("q1",), "N m s/rad", 0.25),
    ),
    (*joints("q1 q2 q3", 3e-4), *speeds("q1 q2 q3", 0.01)), controls("t1 t2 t3", "N m"), three_links, 100, 5.0,
    format=Format("npz"),
)  # fmt: skip


def _loom(rng: Rng) -> Make:
    return lambda size: [Loom(("q2", "q3"), size)]


# ---- geared ---------------------------------------------------------------------------------------------------------


def geared(rng: Rng) -> Motion:
    """Position control behind gears of 60 and 100, the weight of the beam held."""
    goal, push = waves(rng, [1.0, 0.8], 0.15, 1.0), waves(rng, [3.0, 4.0], 1, 4)

    def policy(t: float, d: mujoco.MjData) -> list[float]:
        aim, more = goal(t), push(t)
        yaw = 60 * (aim[0] - d.qpos[0]) - 6 * d.qvel[0] + more[0]
        pitch = 140 * (aim[1] - d.qpos[1]) - 14 * d.qvel[1] + more[1] - 9 * np.cos(d.qpos[1])
        return [yaw / 60, pitch / 100]

    return Motion(policy)


GEARED = Machine(
    "geared_arm.xml",
    (
        Parameter("beam_mass", "body_mass", ("beam",), "kg"),
        Parameter("pitch_damping", "dof_damping", ("pitch",), "N m s/rad", 0.25),
        Parameter("yaw_rotor", "dof_armature", ("yaw",), "kg m^2", 0.2),
    ),
    (*joints("yaw pitch", 2e-4, "deg"), *speeds("yaw pitch", 0.008, "rpm")), controls("m_yaw m_pitch", "N m"),
    geared, 250, 5.0, settle=0.5,
)  # fmt: skip


def _gear(rng: Rng) -> Make:
    level, share = between(rng, 0.1, 0.4), between(rng, 0.1, 0.25)
    return lambda size: [LoadFriction("pitch", level * size, share * size)]


# ---- URDF -----------------------------------------------------------------------------------------------------------


def swinging(rng: Rng) -> Motion:
    """Let go somewhere, with some speed."""
    angles, rates = rng.uniform(-1.2, 1.2, 3) * [1, 1, 0.6], rng.normal(0, 1, 3)

    def start(data: mujoco.MjData) -> None:
        data.qpos[:], data.qvel[:] = angles, rates

    return Motion(lambda t, d: np.zeros(0), start)


SWINGING = Machine(
    "swing_leg.urdf",
    (
        Parameter("shank_mass", "body_mass", ("shank",), "kg"),
        Parameter("knee_damping", "dof_damping", ("knee",), "N m s/rad", 0.3),
        Parameter("hip_damping", "dof_damping", ("hip",), "N m s/rad", 0.3),
    ),
    joints("hip knee ankle", 6e-4, "deg"), (), swinging, 120, 4.0, step=1 / 2400, logs=7,
    format=Format(clock="ms", epoch=1.76e9),
)  # fmt: skip


def _dry_joint(rng: Rng) -> Make:
    joint = str(rng.choice(["hip", "knee"]))
    usual = {"hip": 0.06, "knee": 0.03}[joint]  # N m
    return lambda size: [Coulomb(joint, usual * size)]


CASES = (
    Case("arm2_none", COUNTED, "null", cost=80),
    Case(
        "arm2_pair", TACHO, "pair", _dry_and_late, sizes=(0.1, 1.0), shown=(50, 300), cost=240,
        what="times 0.05 to 0.15 N m of dry friction of el and 8 to 30 ms of delay of m_sh",
    ),
    Case(
        "arm2_bias", TACHO, "single", _bias, sizes=(0.005, 0.05), shown=(20, 130), cost=100,
        what="rad of bias of the encoder at sh, either way",
    ),
    Case("arm6_none", SERVO_ARM, "null", cost=60),
    Case(
        "arm6_payload", SERVO_ARM, "single", _tool, sizes=(0.1, 1.5), shown=(10, 60), cost=110, what="kg at the tool"
    ),
    Case(
        "arm3_loom", LOOMED, "outside", _loom, sizes=(0.01, 1.2), shown=(40, 300), cost=170,
        what="N m/rad^3 of a cable loom over q2 and q3",
    ),
    Case(
        "geared_load", GEARED, "single", _gear, sizes=(0.1, 1.5), shown=(30, 300), cost=130,
        what="times 0.1 to 0.4 N m and 0.1 to 0.25 of the motor's force as friction of pitch",
    ),
    Case("urdf_none", SWINGING, "null", cost=45),
    Case(
        "urdf_coulomb", SWINGING, "single", _dry_joint, sizes=(0.1, 2.0), shown=(10, 100), cost=130,
        what="times 0.06 N m of dry friction of the hip or 0.03 N m of the knee",
    ),
)  # fmt: skip
