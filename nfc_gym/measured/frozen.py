"""A model in which nothing is left that MuJoCo would compute anew from what a correction changes."""

import mujoco
import numpy as np

from nfc_gym.physics.quiet import compiled

_INFERRED = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
_AFFINE = mujoco.mjtBias.mjBIAS_AFFINE


def freeze(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Write into a spec what compilation makes of it, wherever a later compilation could make something else of it.

    These are the damping that a servo's `dampratio` or a joint's `springdamper` asks for, which depends on inertia; the
    ranges that a servo takes over from its joint; the rest lengths of tendons, which are those of the reference pose;
    and inertias where an option of the compiler changes them.

    Returns:
      The compiled model, which is the same before and after.

    Raises:
      ValueError: the spec does not compile.
    """
    model = compiled(spec)[0]
    for actuator in spec.actuators:
        _freeze_actuator(actuator, model)
    for joint in spec.joints:
        if np.any(joint.springdamper):
            at = int(model.jnt_dofadr[joint.id])
            joint.stiffness = [model.jnt_stiffness[joint.id], *np.asarray(joint.stiffness)[1:]]
            joint.damping = [model.dof_damping[at], *np.asarray(joint.damping)[1:]]
            joint.springdamper = 0.0, 0.0
    for tendon in spec.tendons:
        tendon.springlength = model.tendon_lengthspring[tendon.id]
    if _recomputes_inertia(spec.compiler):
        freeze_inertia(spec, model)
    return compiled(spec)[0]


def _freeze_actuator(actuator: mujoco.MjsActuator, model: mujoco.MjModel) -> None:
    i, bias = int(actuator.id), np.asarray(actuator.biasprm)
    if actuator.biastype == _AFFINE and bias[2] > 0 and actuator.gainprm[0] == -bias[1]:  # a damping ratio
        actuator.biasprm = [*model.actuator_biasprm[i, :3], *bias[3:]]
    if actuator.inheritrange > 0:
        for ends, limit in (("ctrlrange", "ctrllimited"), ("actrange", "actlimited")):
            if getattr(model, f"actuator_{limit}")[i]:
                setattr(actuator, ends, getattr(model, f"actuator_{ends}")[i])
                setattr(actuator, limit, mujoco.mjtLimited.mjLIMITED_TRUE)
        actuator.inheritrange = 0.0


def _recomputes_inertia(compiler: mujoco.MjsCompiler) -> bool:
    bounded = compiler.settotalmass > 0 or compiler.boundmass > 0 or compiler.boundinertia > 0
    return bounded or bool(compiler.balanceinertia) or compiler.inertiafromgeom == _INFERRED


def freeze_inertia(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Write a compiled model's masses and inertias into its spec, so that they no longer follow from its geoms."""
    for body in spec.bodies[1:]:  # without the world
        i = int(body.id)
        body.explicitinertial = bool(model.body_mass[i] > 0)
        if body.explicitinertial:
            body.mass, body.inertia, body.fullinertia = model.body_mass[i], model.body_inertia[i], np.full(6, np.nan)
            body.ipos, body.iquat = model.body_ipos[i], model.body_iquat[i]
            body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    plain = mujoco.MjSpec().compiler
    for name in ("inertiafromgeom", "settotalmass", "balanceinertia", "boundmass", "boundinertia"):
        setattr(spec.compiler, name, getattr(plain, name))
