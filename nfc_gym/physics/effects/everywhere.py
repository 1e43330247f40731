"""`where: all`: an effect at every place that its family has in a model, found when it is bound to one."""

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import TIME, Effect, Scales
from nfc_gym.physics.fields import names_of

ALL = "all"
_OBJ = mujoco.mjtObj
_OF_JOINT, _OF_BODY = ("pos", "vel", "acc"), ("pos", "quat", "linvel", "linvel@body", "angvel", "angvel@body")
_FAR = 100.0  # m or rad either way that all coordinates are taken to go: what needs travel is proposed then
_WHOLE = ("ground", "world")  # places that hold all the others


def everywhere(kind: type[Effect]) -> type[Effect]:
    """The family with its places looked up in `bind`, unless the model has something that is called `all`.

    Raises:
      InputError: a family whose `where` says more than a place.
    """
    if kind.generic:
        raise InputError(f"{kind.family}: `where` says what is pushed, and by what; {ALL!r} says neither")

    def bind(self: Effect, model: mujoco.MjModel) -> None:
        if ALL not in _called(model):
            self.where = places_of(self, model)
        kind.bind(self, model)

    return type(kind.__name__, (kind,), {"bind": bind, "__doc__": kind.__doc__})


def places_of(effect: Effect, model: mujoco.MjModel) -> tuple[str, ...]:
    """Every place of a model where an effect of this family, with such parameters, could be proposed.

    A family may have others elsewhere: a force along a joint has one number, a force on a body three.

    Raises:
      InputError: there is none; or several, and the family sits at one alone.
    """
    names = {p.name for p in effect.params}
    scales = _neutral(model)
    every = [*effect.propose(model, scales), *effect.asked(model, scales)]
    proposed = [e for e in every if names & {p.name for p in e.params}]
    found = tuple(dict.fromkeys(name for e in proposed for name in e.where))
    found = next(((name,) for name in _WHOLE if name in found), found)
    if not found:
        raise InputError(f"{effect.family} of {ALL!r}: the model has nothing with a name that it could sit on")
    if effect.lone and len(found) > 1:
        raise InputError(f"{effect.family} of {ALL!r}: it sits at one place alone; choose of: {', '.join(found)}")
    return found


def _called(model: mujoco.MjModel) -> set[str]:
    """Names of whatever an effect can sit on."""
    counts = (
        (_OBJ.mjOBJ_JOINT, model.njnt), (_OBJ.mjOBJ_ACTUATOR, model.nactuator), (_OBJ.mjOBJ_BODY, model.nbody),
        (_OBJ.mjOBJ_GEOM, model.ngeom), (_OBJ.mjOBJ_SENSOR, model.nsensor),
    )  # fmt: skip
    return {name for kind, count in counts for name in names_of(model, kind, count)}


def _neutral(model: mujoco.MjModel) -> Scales:
    """Magnitudes under which a family proposes every place: the sizes that it proposes are not used."""
    return Scales(
        force=np.ones(model.nv), speed=np.ones(model.nv), command=np.ones(model.nu), actuation=np.ones(model.nu),
        interval=float(model.opt.timestep), exogenous={"exo:supply": 1.0, TIME: 1.0},
        channels=dict.fromkeys(_channels(model), (1.0, 0.0)), low=model.qpos0 - _FAR, high=model.qpos0 + _FAR,
    )  # fmt: skip


def _channels(model: mujoco.MjModel) -> list[str]:
    """Every channel that a log of the model could have, of things that have a name."""
    slide, hinge = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
    joints = names_of(model, _OBJ.mjOBJ_JOINT, model.njnt)
    scalar = [n for n, kind in zip(joints, model.jnt_type, strict=True) if n and kind in (slide, hinge)]
    bodies = [n for n in names_of(model, _OBJ.mjOBJ_BODY, model.nbody)[1:] if n]
    sensors = [n for n in names_of(model, _OBJ.mjOBJ_SENSOR, model.nsensor) if n]
    return [
        *(f"joint:{n}:{q}" for n in scalar for q in _OF_JOINT),
        *(f"body:{n}:{q}" for n in bodies for q in _OF_BODY),
        *(f"sensor:{n}" for n in sensors),
    ]
