"""What to record next: for each claim that the logs cannot tell from a rival, the kind of motion that would.

Not a table of sayings: families of motion are tried on the model, and the one in which the two explanations come to lie
farthest apart is named (`design`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Log
from nfc_gym.measured.bench import Bench
from nfc_gym.measured.design import Design
from nfc_gym.measured.distances import Ask, Distances
from nfc_gym.measured.experiment import Stage
from nfc_gym.measured.questions import TOLD, Present, look, rivalries
from nfc_gym.measured.recount import excluded
from nfc_gym.measured.story import rivals_of
from nfc_gym.measured.wording import number

_SECONDS = 5.0  # of the motions that are compared: families differ in kind, not in length
_DRAWS = 1  # of each family


@dataclass(frozen=True)
class Advice:
    """What was found out.

    Attributes:
      rows: the identifiability table, the rows of claims with `sigma`: how far their nearest rival lies in these logs.
      effects: of the report, without the equivalents that all segments exclude where the search saw but some.
      findings: in words, for `report.json`: what to record next, and who is an equivalent no more.
    """

    rows: list[dict[str, Any]]
    effects: list[dict[str, Any]]
    findings: list[dict[str, Any]]


def advise(
    bench: Bench, logs: Sequence[Log], report: dict[str, Any], present: Present, say: Callable[[str], None], seed: int
) -> Advice:
    """Measure how far each claim lies from its rivals, and look for a motion where that is too near.

    Args:
      report: `effects` and `identifiability`, as in `report.json`.
      present: the logs at hand, seen from the extended model.
    """
    rows = [dict(r) for r in report["identifiability"]]
    if not present.lens.plant.effects:
        return Advice(rows, report["effects"], [])
    say("how far the claims lie from their rivals")
    seen = round(present.repeats * len(present.lens.problem))
    asks, pairs, before = _apart(bench, logs, report, present)
    if bench.mode == "rollout" and min(before, default=np.inf) <= TOLD:
        # The present's few segments speak for all: nobody is sent to record more before as many are seen as `excite`
        # sees, whose figures are then the same.
        present = look(bench, logs, present.lens.plant, present.lens.x)
        asks, pairs, before = _apart(bench, logs, report, present)
        before = _refitted(bench, logs, report["effects"], asks, pairs, before, say, seed)
    for row in rows:
        told = zip(before, pairs, strict=True)
        own = [(s, rival) for s, (claim, rival) in told if claim == row["id"] and np.isfinite(s)]
        if own:
            sigma, rival = min(own)
            row |= {"sigma": float(sigma), "worst_mimic": rival, "distinguishable": bool(sigma > TOLD)}
    near = [i for i, s in enumerate(before) if s <= TOLD]
    told_apart = [(a, p) for a, p, s in zip(asks, pairs, before, strict=True) if s > TOLD]
    effects, findings = report["effects"], []
    if bench.mode == "rollout":
        effects, findings = _recounted(bench, logs, effects, told_apart, seen, say, seed)
    if not near:
        return Advice(rows, effects, findings)
    open_asks = [asks[i] for i in near]
    told = _best_motion(bench, logs, present, open_asks, say, seed)
    for k, i in enumerate(near):
        claim, rival = pairs[i]
        text = f"{claim} and {rival} lie {number(before[i], 2)} sigma apart in these logs, too near to choose."
        findings.append({"kind": "advice", "text": f"{text} {told(k)}"})
    return Advice(rows, effects, findings)


def _recounted(
    bench: Bench,
    logs: Sequence[Log],
    effects: list[dict[str, Any]],
    pairs: Sequence[tuple[Ask, tuple[str, str]]],
    seen: int,
    say: Callable[[str], None],
    seed: int,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Effects without the equivalents that all segments exclude, of which the search saw so many; and who they are.

    Of several effects the first were accepted when the others were not there, and what did as well then need not now.
    """
    left = {e["id"]: dict(e) for e in effects}
    listed = [(ask, p) for ask, p in pairs if p[1] in rivals_of(left.get(p[0], {}), effects)]
    whole = bench.searched(logs) if listed else None
    if whole is None or (len(whole) <= seen and len(effects) < 2):
        return effects, []
    findings = []
    for (_, (claim, rival)), gone in zip(listed, excluded(whole, [ask for ask, _ in listed], say, seed), strict=True):
        if gone:
            left[claim]["equivalents"] = [i for i in left[claim]["equivalents"] if i != rival]
            text = f"{rival} does as well as {claim} on the {seen} segments that were searched, and is excluded by all"
            text = (
                f"{text} {len(whole)}"
                if len(whole) > seen
                else f"{rival} does not do as well as {claim} beside the rest"
            )
            findings.append({"kind": "recount", "text": f"{text}: it is no equivalent."})
    return list(left.values()), findings


def _apart(
    bench: Bench, logs: Sequence[Log], report: dict[str, Any], present: Present
) -> tuple[list[Ask], list[tuple[str, str]], list[float]]:
    """The questions that the claims leave open, the ids of claim and rival of each, and their distances in sigma."""
    asks, pairs, _ = rivalries(bench, logs, report, present)
    return asks, pairs, [float(s) for s in Distances(asks, present.lens, present.repeats).before] if asks else []


def _refitted(
    bench: Bench,
    logs: Sequence[Log],
    effects: list[dict[str, Any]],
    asks: Sequence[Ask],
    pairs: Sequence[tuple[str, str]],
    before: Sequence[float],
    say: Callable[[str], None],
    seed: int,
) -> list[float]:
    """The distances, infinite of near rivals that the contest has excluded and that all segments exclude too.

    A distance is that of the rival as slopes would have it; fitted, it may lie much farther off.
    """
    alike = {e["id"]: rivals_of(e, effects) for e in effects}
    near = [i for i, s in enumerate(before) if s <= TOLD and pairs[i][1] not in alike.get(pairs[i][0], [])]
    if not near:
        return list(before)
    gone = excluded(bench.searched(logs), [asks[i] for i in near], say, seed)
    far = {i for i, out in zip(near, gone, strict=True) if out}
    return [float("inf") if i in far else s for i, s in enumerate(before)]


def _best_motion(
    bench: Bench, logs: Sequence[Log], present: Present, asks: list[Ask], say: Callable[[str], None], seed: int
) -> Callable[[int], str]:
    """What to say of each pair: the family of motion that separates the worst of them most."""
    try:
        say("which motion would tell them apart")
        stage = Stage(bench, present.lens.plant, present.lens.x, logs, _SECONDS)
        seen = present if bench.mode == "rollout" else look(bench, logs, present.lens.plant, present.lens.x)
        design = Design(Distances(asks, seen.lens, seen.repeats), stage, rivals=True)
        best = design.families(np.random.default_rng(seed), _DRAWS)[0]
    except InputError as e:
        why = str(e)
        return lambda k: f"{why[:1].upper()}{why[1:]}."
    added = "" if stage.open_loop else " added to what the controller commands"
    command = "`nfc-gym excite MAPPING.yaml --fit DIR` writes such commands."

    def told(k: int) -> str:
        sigma = float(best.answers[k])
        size = f"{number(100 * best.amplitude, 2)} % of the commands' range"
        if sigma <= TOLD:
            return (
                f"None of the kinds of motion that were tried does better than {number(sigma, 2)} sigma in "
                f"{_SECONDS:g} s; another sensor may."
            )
        return f"{_SECONDS:g} s of {best.family.say}{added}, {size}, would make it {number(sigma, 2)}: {command}"

    return told
