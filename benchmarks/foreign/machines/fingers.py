"""What tendons and jaws move: a finger, a cable arm, a parallel gripper."""

import mujoco
import numpy as np

from ..channels import Channel, controls, joints, speeds
from ..drives import Loss
from ..effect import Form, Rng
from ..joints import Coulomb
from ..machine import Case, Format, Machine, Make, Motion, waves
from ..outside import Capstan
from ..parameters import Parameter


def flexing(rng: Rng) -> Motion:
    """Two tendons against each other, about a bent rest."""
    pull, begin = waves(rng, [2.2, 2.0], 0.3, 4), rng.uniform(0.3, 0.7, 3)

    def policy(t: float, d: mujoco.MjData) -> np.ndarray:
        more = pull(t)
        hold = float(np.clip(8 * (d.qpos[0] - 0.5) + 4 * (d.qpos[1] - 0.6) + 0.3 * d.qvel[0], -4, 4))
        return np.clip([-7 - more[0] + hold, -7 - more[1] - hold], -40, 0)

    def start(data: mujoco.MjData) -> None:
        data.qpos[:] = begin

    return Motion(policy, start)


FINGER = Machine(
    "finger.xml",
    (
        Parameter("proximal_mass", "body_mass", ("proximal",), "kg"),
        Parameter("mcp_damping", "dof_damping", ("mcp",), "N m s/rad", 0.25),
        Parameter("pip_stiffness", "jnt_stiffness", ("pip",), "N m/rad", 0.2),
    ),
    joints("mcp pip dip", 1e-3), controls("flex ext", "N"), flexing, 200, 4.0,
    step=0.00025, settle=0.5, format=Format("npz"),
)  # fmt: skip


def _sheath(rng: Rng) -> Make:
    near = [Form("load_friction", (j,)) for j in ("mcp", "pip")]  # what it is at one joint, in straight lines
    return lambda size: [Capstan("flexor", "flex", ("mcp", "pip"), size, near)]


def winching(rng: Rng) -> Motion:
    """Three cables that stay tight."""
    pull = waves(rng, [7.0, 7.0, 5.0], 0.2, 2.5)

    def policy(t: float, d: mujoco.MjData) -> np.ndarray:
        more, hold = pull(t), 12 * d.qpos[0] + 2 * d.qvel[0]
        return np.clip([-15 + more[0] - hold, -15 + more[1] + hold, -9 + more[2]], [-60, -60, -40], 0)

    return Motion(policy)


CABLES = Machine(
    "cable_arm.xml",
    (
        Parameter("boom_mass", "body_mass", ("boom",), "kg"),
        Parameter("jib_mass", "body_mass", ("jib",), "kg"),
        Parameter("luff_spring", "jnt_stiffness", ("luff",), "N m/rad", 0.2),
    ),
    (*joints("lift luff", 5e-4, "deg"), *speeds("lift luff", 0.01, "deg/s")),
    controls("w_front w_back w_tip", "N"), winching, 100, 5.0, format=Format("npz"),
)  # fmt: skip


def _weak_winch(rng: Rng) -> Make:
    winch = str(rng.choice(["w_front", "w_back", "w_tip"]))
    moved = ["luff"] if winch == "w_tip" else ["lift"]
    return lambda size: [Loss(winch, size, moved)]


def gripping(rng: Rng) -> Motion:
    """The jaws close on the block and open again."""
    goal = waves(rng, 0.011, 0.3, 3)
    return Motion(lambda t, d: np.clip(0.016 + goal(t), -0.005, 0.035))


GRIPPER = Machine(
    "gripper.xml",
    (
        Parameter("kp", "servo_kp", ("grip",), "N/m"),
        Parameter("jaw_damping", "dof_damping", ("jaw_l",), "N s/m", 0.25),
    ),
    (Channel("joint:jaw_l:pos", ("left",), "mm", 2e-5), Channel("joint:jaw_r:pos", ("right",), "mm", 2e-5),
     Channel("joint:shift:pos", ("block",), "mm", 5e-5)),
    controls("grip", "mm"), gripping, 200, 4.0, settle=0.3,
)  # fmt: skip


def _dry_jaw(rng: Rng) -> Make:
    # The jaws are coupled: friction of the one is friction of the other, or a half of it of each.
    def make(size: float) -> list:
        return [
            Coulomb("jaw_l", size, [Form("coulomb", ("jaw_r",), {"level": size}), Form("coulomb", ("jaw_l", "jaw_r"))])
        ]

    return make


CASES = (
    Case("finger_none", FINGER, "null", cost=65),
    Case(
        "finger_sheath",
        FINGER,
        "outside",
        _sheath,
        what="of friction of the flexor in its sheath (capstan)",
        sizes=(0.01, 0.3),
        shown=(12, 80),
        cost=770,
    ),
    Case(
        "cable_loss",
        CABLES,
        "single",
        _weak_winch,
        what="of a cable's force lost",
        sizes=(0.01, 0.4),
        shown=(10, 100),
        cost=130,
    ),
    Case("gripper_none", GRIPPER, "null", cost=90),
    Case(
        "gripper_coulomb",
        GRIPPER,
        "single",
        _dry_jaw,
        what="N of dry friction of a jaw",
        sizes=(0.1, 3.0),
        shown=(10, 100),
        cost=210,
    ),
)
