"""Hoists and cranes: a gantry with a swinging load, and a drum on a battery that lifts an arm."""

import mujoco
import numpy as np

from ..channels import Channel, Control, Signal, joints, speeds
from ..drives import Lag, SupplySag
from ..effect import Effect, Rng
from ..joints import Coulomb
from ..machine import Case, Machine, Make, Motion, between, waves
from ..outside import Grease
from ..parameters import Parameter


def hauling(rng: Rng) -> Motion:
    """The carriage is pushed about and led back softly; the hook goes up and down."""
    goal = waves(rng, [35.0, 0.1], 0.15, 1.2)

    def policy(t: float, d: mujoco.MjData) -> list[float]:
        force, depth = goal(t)
        return [force - 40 * d.qpos[0] - 10 * d.qvel[0], depth]

    return Motion(policy)


CRANE = Machine(
    "crane.xml",
    (
        Parameter("carriage_mass", "body_mass", ("carriage",), "kg"),
        Parameter("load_mass", "body_mass", ("hook",), "kg"),
        Parameter("bridge_damping", "dof_damping", ("bridge",), "N s/m", 0.25),
    ),
    (*joints("bridge", 3e-4, "mm"), Channel("joint:swing:pos", ("swing",), "deg", 6e-4),
     Channel("joint:hoist:pos", ("depth",), "cm", 3e-4)),
    (Control("drive", "force", "N"), Control("winch", "goal", "mm")), hauling, 50, 6.0,
)  # fmt: skip


def _grease(rng: Rng) -> Make:
    start = between(rng, -0.5, -0.2)
    return lambda size: [Grease("bridge", size, start)]


def _dry_and_slow(rng: Rng) -> Make:
    friction, tau = between(rng, 8, 16), between(rng, 0.04, 0.1)

    def make(size: float) -> list[Effect]:
        return [Coulomb("bridge", size * friction), Lag(["drive"], size * tau, ["bridge"])]

    return make


RATED = 24.0  # V


def lifting(rng: Rng) -> Motion:
    """Position control of the drum, the arm's weight held."""
    goal, push = waves(rng, 0.5, 0.15, 1.0), waves(rng, 0.05, 1, 4)

    def policy(t: float, d: mujoco.MjData) -> list[float]:
        hold = -1.96 / 20 * np.cos(d.qpos[1])
        return [hold + 0.12 * (goal(t)[0] - d.qpos[0]) - 0.02 * d.qvel[0] + push(t)[0]]

    return Motion(policy)


def battery(rng: Rng):
    """Volts that fall, and swing with what else is switched on."""
    full, fall, rate, phase = between(rng, 22, 25), between(rng, 0.1, 0.4), between(rng, 0.2, 0.8), between(rng, 0, 6)
    return lambda t: full - fall * t + 0.6 * np.sin(2 * np.pi * rate * t + phase)


HOIST = Machine(
    "hoist.xml",
    (
        Parameter("arm_mass", "body_mass", ("arm",), "kg"),
        Parameter("drum_mass", "body_mass", ("drum",), "kg"),
        Parameter("shaft_damping", "dof_damping", ("shaft",), "N m s/rad", 0.25),
    ),
    (*joints("shaft", 5e-4, "deg"), *joints("hinge", 4e-4, "deg"), *speeds("shaft", 0.01, "rpm")),
    (Control("winch", "torque", "N m"),), lifting, 100, 5.0, settle=0.5,
    signals=(Signal("supply", "vbat", "V", 0.01, battery),),
)  # fmt: skip


def _sag(rng: Rng) -> Make:
    return lambda size: [SupplySag("winch", size, RATED, ["shaft", "hinge"])]


CASES = (
    Case("crane_none", CRANE, "null", cost=55),
    Case(
        "crane_pair",
        CRANE,
        "pair",
        _dry_and_slow,
        what="times 8 to 16 N of dry friction at the bridge and 40 to 100 ms of lag of its drive",
        sizes=(0.2, 1.2),
        shown=(30, 120),
        cost=200,
    ),
    Case(
        "crane_grease",
        CRANE,
        "outside",
        _grease,
        what="N s/m^3 of drag that grows with the square of the way along the rail",
        sizes=(100.0, 450.0),
        shown=(15, 80),
        cost=170,
    ),
    Case(
        "hoist_sag",
        HOIST,
        "single",
        _sag,
        what="as the power of the supply's volts that the winch's force goes with",
        sizes=(0.8, 1.6),
        shown=(15, 200),
        cost=150,
    ),
)
