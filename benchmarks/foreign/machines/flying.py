"""What flies and swims: a quadrotor and an underwater vehicle."""

import mujoco
import numpy as np

from ..bodies import Drag
from ..channels import Channel, controls
from ..drives import Lag, Loss
from ..effect import Array, Effect, Rng
from ..machine import Case, Format, Machine, Make, Motion, between, waves
from ..outside import Tether
from ..parameters import Parameter

# ---- quadrotor ------------------------------------------------------------------------------------------------------

WEIGHT = 0.95 * 9.81  # N
CENTRE = np.array([0.0, 0.0, 1.5])  # m, that goals lie about
ARM, TWIST = 0.13, 0.016  # m; N m of yaw a newton of thrust
MIX = np.array([[1, 1, 1, 1], [ARM, ARM, -ARM, -ARM], [-ARM, ARM, ARM, -ARM], [TWIST, -TWIST, TWIST, -TWIST]])
ROTORS = ("t1", "t2", "t3", "t4")


def _axes(quaternion: Array) -> Array:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, quaternion)
    return out.reshape(3, 3)


def hovering(size: float):
    """Flight to goals about `size` metres to each side, with shaken thrusts."""

    def motion(rng: Rng) -> Motion:
        goal, push = waves(rng, [size, size, 0.35, 0.6], 0.1, 0.6), waves(rng, [0.12] * 4, 1, 5)

        def policy(t: float, d: mujoco.MjData) -> Array:
            axes, aim, rate = _axes(d.qpos[3:7]), goal(t), d.qvel[3:6]
            pull = np.clip(2.5 * (aim[:3] + CENTRE - d.qpos[:3]) - 2.2 * d.qvel[:3], -4, 4)  # m/s^2
            yaw = np.arctan2(axes[1, 0], axes[0, 0])
            c, s = np.cos(yaw), np.sin(yaw)
            lean = np.array([-(c * pull[1] - s * pull[0]), c * pull[0] + s * pull[1]]) / 9.81
            up = axes[2]
            moments = 0.8 * (lean - [up[1], -up[0]]) - 0.12 * rate[:2]
            wanted = [WEIGHT * (1 + pull[2] / 9.81), *moments, 0.04 * (aim[3] - yaw) - 0.03 * rate[2]]
            return np.clip(np.linalg.solve(MIX, wanted) + push(t), 0, 7)

        return Motion(policy)

    return motion


def _drone(size: float) -> Machine:
    return Machine(
        "drone.xml",
        (
            Parameter("frame_mass", "body_mass", ("frame",), "kg", 0.1),
            Parameter("battery_mass", "body_mass", ("battery",), "kg", 0.1),
        ),
        (
            Channel("body:frame:pos", ("x", "y", "z"), "m", 1e-3),
            Channel("body:frame:quat", ("qx", "qy", "qz", "qw"), "1", 2e-3, order="xyzw"),
            Channel("body:frame:linvel", ("vx", "vy", "vz"), "m/s", 0.01),
            Channel("body:frame:angvel@body", ("gx", "gy", "gz"), "deg/s", 0.01),
        ),
        controls("t1 t2 t3 t4", "N"), hovering(size), 100, 4.0, step=0.001, settle=0.5, format=Format("npz"),
    )  # fmt: skip


def _slow_rotors(rng: Rng) -> Make:
    return lambda size: [Lag(ROTORS, size, ["frame"])]


def _weak_and_dragged(rng: Rng) -> Make:
    rotor, lost, drag = str(rng.choice(ROTORS)), between(rng, 0.02, 0.05), between(rng, 0.6, 1.2)

    def make(size: float) -> list[Effect]:
        c = drag * size
        return [Loss(rotor, lost * size, ["frame"]), Drag("frame", (c, c, 1.5 * c), quadratic=False)]

    return make


# ---- underwater -----------------------------------------------------------------------------------------------------

THRUSTERS = "surge_l surge_r heave_f heave_b sway"


def diving(rng: Rng) -> Motion:
    """Thrusts to all sides about a depth of 2 m, kept level."""
    push = waves(rng, [25.0, 4.0, 15.0, 15.0, 35.0], 0.1, 0.8)

    def policy(t: float, d: mujoco.MjData) -> list[float]:
        axes, rate = _axes(d.qpos[3:7]), d.qvel[3:6]
        own, level, depth = axes.T @ d.qvel[:3], -14 * axes[2, 0] + 3 * rate[1], 8 * (d.qpos[2] + 2)
        surge, turn, front, back, sway = push(t)
        turn += 6 * rate[2]
        return [
            surge + turn - 2 * own[0],
            surge - turn - 2 * own[0],
            front + 1.2 * level - 3 * own[2] - depth,
            back - 1.2 * level - 3 * own[2] - depth,
            sway - 4 * own[1],
        ]

    return Motion(policy)


ROV = Machine(
    "rov.xml",
    (
        Parameter("hull_mass", "body_mass", ("hull",), "kg", 0.1),
        Parameter("sway_gain", "actuator_gainprm[0]", ("sway",), "1", 0.1),
    ),
    (
        Channel("body:hull:pos", ("x", "y", "z"), "m", 3e-3, rate=10),
        Channel("body:hull:quat", ("qw", "qx", "qy", "qz"), "1", 3e-3, order="wxyz"),
        Channel("body:hull:linvel@body", ("u", "v", "w"), "m/s", 0.008),
        Channel("body:hull:angvel@body", ("p", "q", "r"), "rad/s", 0.005),
    ),
    controls(THRUSTERS, "N"), diving, 50, 6.0, step=0.002, logs=5,
)  # fmt: skip


def _water(rng: Rng) -> Make:
    shape = np.array([20, 35, 45]) * rng.uniform(0.7, 1.3, 3)
    return lambda size: [Drag("hull", list(size * shape), quadratic=True)]


def _tether(rng: Rng) -> Make:
    slack = between(rng, 0.35, 0.5)
    return lambda size: [Tether("hull", (0.0, 0.0, -1.7), slack, size)]


CASES = (
    Case("drone_none", _drone(0.6), "null", cost=50),
    Case(
        "drone_lag",
        _drone(0.6),
        "single",
        _slow_rotors,
        what="s of lag of all rotors",
        sizes=(0.005, 0.06),
        shown=(6, 60),
        cost=110,
    ),
    Case(
        "drone_pair",
        _drone(1.2),
        "pair",
        _weak_and_dragged,
        what="times 2 to 5 % of a rotor's force lost and 0.6 to 1.2 N s/m of linear drag",
        sizes=(0.2, 3.0),
        shown=(30, 120),
        cost=430,
    ),
    Case(
        "rov_drag",
        ROV,
        "single",
        _water,
        what="times about 20, 35 and 45 N s^2/m^2 of quadratic drag",
        sizes=(0.02, 1.5),
        shown=(6, 40),
        cost=75,
    ),
    Case(
        "rov_tether",
        ROV,
        "outside",
        _tether,
        what="N/m of a tether that is slack up to 0.35 to 0.5 m",
        sizes=(3.0, 120.0),
        shown=(8, 40),
        cost=100,
    ),
)
