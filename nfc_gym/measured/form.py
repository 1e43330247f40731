"""Whether a claimed law has the form of what is at work at its place.

A law that stands in for another one at the same joint takes most of it away and leaves there what differs: a motor that
cogs and turns little is nearly a spring, and so is a hysteresis within its travel. A smooth function of the joint's
position, speed, time or past then brings a good part of what the claim brought, and beside it the claim is not needed.
Beside a law that is at work it brings next to nothing, however far the rest of the model is from the machine. A
spring that yields is itself a function of the joint's past: of its form, and not of the cause, a better one speaks.
"""

from collections.abc import Sequence

import mujoco

from nfc_gym.measured.arena import Arena
from nfc_gym.measured.contest import Judged, fitted_residual
from nfc_gym.measured.fit import Fit
from nfc_gym.measured.metric import loss, metric
from nfc_gym.measured.screen import Screen
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.generic import GenericMemory
from nfc_gym.physics.effects.hysteresis import Hysteresis
from nfc_gym.physics.names import names

_TRIED = 2  # smooth functions that are fitted beside a claim: straight lines do not rank them surely
_MENDS = 0.05  # of the loss that a claim takes away: what such a function brings where the claim's form is another's
_NEEDED = 0.5  # of it: what a claim whose form is right still brings beside that function


def misshapen(arena: Arena, generics: Sequence[Effect], worth: float) -> dict[str, Judged]:
    """Accepted effects at joints or their drives, beside which a smooth function there brings a good part as much.

    Args:
      arena: whose model to beat has the effects.
      generics: smooth functions of one variable, each on one degree of freedom.
      worth: share of the misfit that such a function must explain.

    Returns:
      Ids of the effects, each with the smooth function fitted beside it.
    """
    out: dict[str, Judged] = {}
    screen = Screen(arena.fit_data.problem, arena.under, arena.current)
    for effect in arena.current.plant.effects:
        at = _joints(arena.current.plant.model, effect.where)
        asked = [g for g in generics if g.where[0] in at and not _of_its_kind(effect, g)]
        tried = sorted((screen.try_one(g) for g in asked), key=lambda s: -s.gain)
        hopeful = [s for s in tried[:_TRIED] if arena.promises(s) > arena.asked(s, worth)]
        if not hopeful:
            continue
        arena.say(f"asking whether a smooth force mends what {effect.id} leaves there")
        beside = max((arena.enter([s]) for s in hopeful), key=lambda j: j.total)
        if not arena.worth(beside, worth):
            continue
        bare = arena.without(effect)
        without, alone, mended = (_loss(arena, f) for f in (bare.current, arena.current, beside.fitted))
        if alone - mended <= _MENDS * (without - alone):
            continue
        again = Screen(bare.fit_data.problem, bare.under, bare.current).try_one(arena.new(beside)[0])
        # Where two laws act at one joint it is the one that is not needed any more whose form is another's.
        if _loss(arena, bare.enter([again]).fitted) - mended < _NEEDED * (without - alone):
            out[effect.id] = beside
    return out


def _of_its_kind(effect: Effect, generic: Effect) -> bool:
    """Whether a smooth function has an effect as one of its terms, whatever it mends of what that leaves."""
    return effect.family == Hysteresis.family and isinstance(generic, GenericMemory)


def _loss(arena: Arena, fitted: Fit) -> float:
    """What a model leaves on both sets of logs, by the noise alone: slack would make little of what is asked about."""
    sides = arena.fit_data, arena.select
    whites = (metric(d.problem, d.sigma).whiten(fitted_residual(d.problem, fitted)) for d in sides)
    return sum(float(loss(white).sum()) for white in whites)


def _joints(model: mujoco.MjModel, where: Sequence[str]) -> set[str]:
    """Joints of a law that acts at joints, or at the drives of joints."""
    known = names(model)
    drives = [known.actuators.index(n) for n in where if n in known.actuators]
    of_joint = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    driven = {known.joints[model.actuator_trnid[i, 0]] for i in drives if model.actuator_trntype[i] in of_joint}
    return driven | {n for n in where if n in known.joints}
