"""What the objects of a model are called, also where its author gave them no name."""

from dataclasses import dataclass

import mujoco

from nfc_gym.physics.fields import names_of
from nfc_gym.physics.quiet import compiled

_OBJ = mujoco.mjtObj


@dataclass(frozen=True)
class Names:
    """Names of a model's objects, in the order of their ids, none of them empty."""

    actuators: list[str]
    joints: list[str]
    bodies: list[str]
    sensors: list[str]


def names(model: mujoco.MjModel) -> Names:
    """The model's own names; an unnamed actuator is called after the joint it moves, all else by kind and number."""
    joints = _filled(names_of(model, _OBJ.mjOBJ_JOINT, model.njnt), "joint")
    bodies = _filled(names_of(model, _OBJ.mjOBJ_BODY, model.nbody), "body")
    actuators = names_of(model, _OBJ.mjOBJ_ACTUATOR, model.nactuator)
    for i, name in enumerate(actuators):
        moves = int(model.actuator_trntype[i]) == int(mujoco.mjtTrn.mjTRN_JOINT)
        joint = joints[int(model.actuator_trnid[i, 0])] if moves else ""
        actuators[i] = name or (joint if joint not in actuators else "")
    return Names(
        _filled(actuators, "actuator"),
        joints,
        bodies,
        _filled(names_of(model, _OBJ.mjOBJ_SENSOR, model.nsensor), "sensor"),
    )


def name_all(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Give each actuator, joint, body and sensor of a model that has no name the one that `names` calls it by.

    Raises:
      ValueError: the model does not compile.
    """
    called = names(compiled(spec)[0])  # which also tells each its id
    for objects, wanted in (
        (spec.actuators, called.actuators),
        (spec.joints, called.joints),
        (spec.bodies, called.bodies),
        (spec.sensors, called.sensors),
    ):
        for thing in objects:
            if not thing.name:
                thing.name = wanted[int(thing.id)]
    return spec


def _filled(given: list[str], kind: str) -> list[str]:
    out = list(given)
    for i, name in enumerate(given):
        own = f"{kind}_{i}"
        while not name and own in out:  # another may be called so
            own += "_"
        out[i] = name or own
    return out
