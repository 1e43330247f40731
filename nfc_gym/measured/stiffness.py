"""Joints whose servo or damping is too stiff for the physics step, where they touch something.

MuJoCo's implicit integrators damp a joint within the step, but its contacts are solved before that, for a joint that is
free: where the damping alone would stop the joint in less than a step, friction is solved for a wheel that gives way,
and acts on one that does not. How it grips then hangs on the step. A skid-steer rover whose servos held light wheels 46
times too stiffly for its step was off by 0.16 rad after two seconds, against half the step.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.findings import Finding
from nfc_gym.physics.fields import names_of

MOST = 5.0  # times its inertia that damping may be in a step: at ten times a skid is off by a fifth (test_stiffness.py)
HELD = 1e5  # times: such a joint was not damped to move slowly but held fast (1e10 and more in Gymnasium's Fetch)
_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)


class Stiff(NamedTuple):
    """A joint that its damping stops within a step.

    Attributes:
      joint: its name.
      settles: s, inertia over damping.
      armature: kg m^2 or kg, with which it would take a step to settle.
      slides: or turns.
    """

    joint: str
    settles: float
    armature: float
    slides: bool


def stiff_joints(model: mujoco.MjModel, step: float) -> list[Stiff]:
    """Hinges and slides of bodies that may touch others, damped by more than `MOST` times their inertia in a step."""
    damping, touching = _damping(model), _touching(model)
    names = names_of(model, mujoco.mjtObj.mjOBJ_JOINT, model.njnt)
    out = []
    for j, name in enumerate(names):
        dof, kind = int(model.jnt_dofadr[j]), int(model.jnt_type[j])
        if kind not in (_HINGE, _SLIDE) or int(model.jnt_bodyid[j]) not in touching:
            continue
        inertia, stops = float(model.dof_M0[dof]), float(damping[dof])
        if stops * step > MOST * inertia > 0:
            more = float(model.dof_armature[dof]) + stops * step - inertia
            out.append(Stiff(name, inertia / stops, more, kind == _SLIDE))
    return out


def stiffness_findings(model: mujoco.MjModel, step: float) -> Iterator[Finding]:
    """What to say of them: a warning of those that are led, with the stiffest, and one of those that damping holds."""
    found = stiff_joints(model, step)
    held = [s for s in found if s.settles * HELD < step]
    led = [s for s in found if s not in held]
    if held:
        yield Finding(
            "warning",
            "model",
            f"{_list([s.joint for s in held])}: damping holds it as if it were welded, and MuJoCo solves contacts as "
            "if it were free",
            "take the joint out of the model: without one a body is fixed to its parent",
        )
    if not led:
        return
    worst = min(led, key=lambda s: s.settles)
    unit = "kg" if worst.slides else "kg m^2"
    yield Finding(
        "warning",
        "model",
        f"{_list([s.joint for s in led])} would settle in as little as {worst.settles:.2g} s by damping and servo "
        f"alone, against a step of {step:g} s: grip and slip there hang on the step",
        f"shorten segments.timestep to {worst.settles:.1g}, or make such joints heavier: an armature of "
        f"{worst.armature:.2g} {unit} changes nothing where their speeds are led anyway",
    )


def _damping(model: mujoco.MjModel) -> NDArray[np.float64]:
    """(nv,) of joints and of the servos that act on them."""
    out = np.array(model.dof_damping, float)
    joint = int(mujoco.mjtTrn.mjTRN_JOINT)
    for a in range(model.nu):
        if int(model.actuator_trntype[a]) == joint:
            dof = int(model.jnt_dofadr[int(model.actuator_trnid[a, 0])])
            out[dof] += max(0.0, -float(model.actuator_biasprm[a, 2])) * float(model.actuator_gear[a, 0]) ** 2
    return out


def _touching(model: mujoco.MjModel) -> set[int]:
    """Bodies that carry a colliding geom themselves."""
    collide = (np.asarray(model.geom_contype) | np.asarray(model.geom_conaffinity)) != 0
    return set(np.asarray(model.geom_bodyid)[collide].tolist())


def _list(names: Sequence[str]) -> str:
    shown = ", ".join(repr(n) for n in names[:4])
    return f"joint{'s' if len(names) > 1 else ''} {shown}" + (f" and {len(names) - 4} more" if len(names) > 4 else "")
