"""The rest in words: which degree of freedom is wrong, what the misfit looks like there, and what comes nearest."""

from typing import Any, NamedTuple

import mujoco
import numpy as np

from nfc_gym.measured import wording
from nfc_gym.measured.forced import surest
from nfc_gym.measured.laws import Proposal
from nfc_gym.measured.search import Found
from nfc_gym.measured.verdict import Verified
from nfc_gym.physics.effects import FAMILIES
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.generic import GenericMemory, GenericVelocity
from nfc_gym.physics.effects.generic_ground import GenericTread
from nfc_gym.physics.effects.generic_inner import GenericInner
from nfc_gym.physics.effects.ground import base_on_ground
from nfc_gym.physics.effects.law import Law, degrees
from nfc_gym.physics.effects.law_waves import LawHarmonic
from nfc_gym.physics.rollout import Plant

_SPEEDS = ("law_power", "law_friction", "law_cross")


def unexplained(
    v: Verified, found: Found, plant: Plant, rows: list[dict[str, Any]], weak: list[dict[str, Any]], taken: float
) -> dict[str, Any]:
    """The report's `unexplained`, for a verdict of that name or `partly explained`.

    Args:
      v: on the verification logs.
      found: what the search found.
      plant: the extended machine.
      rows: the report's rows of the proposed laws.
      weak: and of effects that were found and are not shown to be the cause.
      taken: share of the error that these explain.
    """
    laws = [e for e in plant.effects if isinstance(e, Law)]
    nearest, share = (" + ".join(r["id"] for r in weak), max(taken, 0.0)) if weak else _nearest(found)
    out: dict[str, Any] = {"nearest": nearest, "nearest_share": share, "proposed": [r["id"] for r in [*weak, *rows]]}
    near = f"; the nearest named effect, {nearest}, explains {share:.0%}" if nearest else "; no named effect comes near"
    if weak:
        near += " together with that" if laws else ""
        alike = list(dict.fromkeys(i for r in weak for i in r["alike"]))
        mended = list(dict.fromkeys(r["mended_by"] for r in weak if "mended_by" in r))
        if mended:
            near += f", but {' and '.join(map(wording.smooth, mended))} mends much of what that leaves"
        elif alike:
            near += f", but {', '.join(alike)} would explain nearly as much"
        elif all("may_be_none" in r for r in weak):
            near += ", and by its intervals may have no size at all"
        else:
            near += ", too little to be the cause"
    assert found.rest is not None
    claimed = {e.id for e in plant.effects if not e.generic} - {r["id"] for r in weak}
    # What is no cause explains nothing: where it all is guesses, what they mend is part of what is to be placed.
    scanned = (None if claimed or not weak else found.rest.bare) or found.rest.scanned
    reason = found.rounds[-1].reason or "no effect of the library explains it"
    if laws:
        parts = [f"{law.what}: {_inner(r['sentence'])}" for law, r in zip(laws, rows, strict=True)]
        text = f"looks like {', and '.join(parts)}{near}"
        return _place(plant.model, laws[0]) | out | {"description": f"{text}; {reason}" if "alike" in reason else text}
    if found.generic is not None:
        at, what = _smooth(plant.model, found, found.generic)
        return at | out | {"description": f"looks like {what}, of no law of the library{near}"}
    if found.hinted is not None:
        at, what = _smooth(plant.model, found, found.hinted)
        text = f"most like {what}, but not surely on unseen logs"
        return at | out | {"description": f"{text}{_elsewhere(v, at)}; {reason}{near}"}
    if scanned is not None:
        joint, guess = surest(scanned.evidence), scanned.nearest
        if joint is not None and (guess is None or _joint_of(guess.law) != joint):
            at = _joint(plant.model, joint)
            text = f"a force of unknown course on {joint} explains it best, and no law of it is sure"
            return at | out | {"description": f"{text}{_elsewhere(v, at)}; {reason}{near}"}
        if guess is not None:
            guess.law.bind(plant.model)
            at = _place(plant.model, guess.law, any(guess is p for p in scanned.proposals))
            return at | out | {"description": f"{_guess(guess)}{_elsewhere(v, at)}; {reason}{near}"}
    worst = _worst(v)
    quantity = f" in its {worst.group}" if worst.named else ""
    text = f"furthest beyond the noise{quantity}, with {worst.times:.3g} times its mean square; {reason}{near}"
    return {"coordinate": worst.channel, "where": worst.place} | out | {"description": text}


def _inner(sentence: str) -> str:
    """A sentence as part of a longer one."""
    return sentence[:1].lower() + sentence[1:].rstrip(".")


def _guess(near: Proposal) -> str:
    return f"depends most on {near.law.what}, which takes away {near.share:.0%} of it, but not surely on unseen logs"


def _smooth(model: mujoco.MjModel, found: Found, generic: str) -> tuple[dict[str, str], str]:
    """`coordinate` and `where` of a generic alternative, and what it is, in words."""
    family, _, name = generic.partition(":")
    if family == GenericMemory.family:
        return _degree(model, name, False), f"a force with memory in {name}"
    if not (kind := FAMILIES[family]).wordless:
        return _degree(model, name, family == GenericVelocity.family), wording.smooth(generic)
    sentences = (r["sentence"] for round_ in found.rounds for r in round_.ranking if r["id"] == generic)
    what = _inner(next(sentences, f"{kind.summary}, {name}"))  # one that was not refitted has no sizes
    if family == GenericTread.family:
        return _degree(model, name, False), what
    if family == GenericInner.family:
        return _joint(model, name), what
    root = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, base_on_ground(model))
    # a base without a name has no channel
    return {"coordinate": f"body:{root}:pos" if root else "ground", "where": "ground"}, what


def _place(model: mujoco.MjModel, law: Effect, sure: bool = True) -> dict[str, str]:
    """`coordinate` (a channel that shows the degree of freedom) and `where` of a law.

    What repeats with the turn of a part comes from that part, whatever it pushes, if it is `sure` that it repeats.
    """
    if sure and law.family == LawHarmonic.family:
        return _degree(model, law.where[-1], False)
    return _degree(model, law.where[0], law.family in _SPEEDS)


def _degree(model: mujoco.MjModel, name: str, speed: bool) -> dict[str, str]:
    """The same of a degree of freedom: a joint's, or one of the six of a free one, `[i]` and with `@body` its own axes.

    No component of a quaternion is the turn about an axis, and no place is along a body's own: what shows these is
    their rate. MuJoCo's free joints turn about the body's own axes.
    """
    joint, _, rest = name.partition("[")
    if not rest:
        return {"coordinate": f"joint:{joint}:{'vel' if speed else 'pos'}", "where": f"joint:{joint}"}
    i, name, own = int(rest[0]), name.removesuffix("@body"), rest.endswith("@body")
    dof, _ = degrees(model)[name]
    body = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, int(model.dof_bodyid[dof]))
    channel = "angvel@body" if i > 2 else "linvel@body" if own else "linvel" if speed else "pos"
    # a body without a name has no channel
    return {"coordinate": f"body:{body}:{channel}[{i % 3}]" if body else f"joint:{name}", "where": f"joint:{name}"}


def _joint_of(law: Effect) -> str:
    """The joint that a law pushes."""
    return law.where[0].partition("[")[0]


def _joint(model: mujoco.MjModel, joint: str) -> dict[str, str]:
    """`coordinate` and `where` of a joint; of a free one its body's place."""
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
    if index < 0 or model.jnt_type[index] != mujoco.mjtJoint.mjJNT_FREE:
        return {"coordinate": f"joint:{joint}:pos", "where": f"joint:{joint}"}
    body = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, int(model.jnt_bodyid[index]))
    # a body without a name has no channel
    return {"coordinate": f"body:{body}:pos" if body else f"joint:{joint}", "where": f"joint:{joint}"}


def _nearest(found: Found) -> tuple[str | None, float]:
    """The named effect that took away most of what was left where none was believed, and its share of that.

    Where a law outdid all named effects together, that is the best of the first round.
    """
    outdone = found.rest is not None and bool(found.rest.dropped)
    rows = [r for r in found.rounds[0 if outdone else -1].ranking if not r["generic"]]
    best = max(rows, key=lambda r: r["share"], default=None)
    if best is not None:
        return best["id"], float(np.clip(best["share"], 0, 1))
    # Screening saw none that gains anything; it leads with the one that comes nearest all the same.
    return found.nearest, 0.0


def _elsewhere(v: Verified, at: dict[str, str]) -> str:
    """Where the misfit is largest, if that is not where the force acts that would do something about it."""
    worst = _worst(v)
    if worst.place == at["where"] or at["coordinate"].startswith(f"{worst.place}:"):
        return ""
    words = f"{worst.place} ({worst.group})" if worst.named else worst.place
    return f"; furthest beyond the noise is {words}, with {worst.times:.3g} times its mean square"


class _Worst(NamedTuple):
    """Place, report group and channel of columns, and how many times a perfect model's misfit theirs is."""

    place: str
    group: str
    channel: str
    times: float

    @property
    def named(self) -> bool:
        """Whether the group says more than the place."""
        return not self.place.startswith("sensor")


def _worst(v: Verified) -> _Worst:
    """The columns whose misfit is most times what a perfect model would show there.

    A wrong joint shows most in itself, however small a part of all the misfit that is: what it moves is the whole
    machine, in many more numbers.
    """
    found, floor = v.column_means("extended"), np.maximum(v.floor, 1e-6)
    count = v.problem.mask.sum(0)
    keys = list(zip(v.problem.columns.place, v.problem.columns.group, strict=True))
    times = {}
    for key in dict.fromkeys(keys):
        of = np.array([k == key for k in keys])
        times[key] = float((count * found)[of].sum() / max((count * floor)[of].sum(), 1e-9))
    place, group = max(times, key=lambda k: times[k])
    channel = v.problem.columns.channel[keys.index((place, group))]
    return _Worst(place, group, channel, times[(place, group)])
