"""What a report is worth, given what was hidden: outcomes, parameters, and whether a miss was foretold."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nfc_gym.measured.demo import judge
from nfc_gym.measured.hidden import Array, Hidden
from nfc_gym.physics.effects.base import Effect

from .kinds import Outside
from .outside import parts
from .row import Estimate, Row

Report = Mapping[str, Any]


def named(claim: Mapping[str, Any], hidden: Hidden) -> bool:
    """Whether a claim, or the one equivalent reported beside it, is the hidden effect at its place."""
    return judge({"effects": [claim]}, hidden.family, hidden.where) == "right"


def score(row: Row, report: Report, hidden: Hidden, outside: Outside | None = None) -> None:
    """Fill in claims, outcome and class size."""
    claims, truths = report["effects"], parts(hidden)
    row.verdict = report["verdict"]
    row.claims = [" = ".join([e["id"], *e["equivalents"]]) for e in claims]
    if outside is not None:
        _outside(row, report, hidden, outside)
        return
    right = [c for c in claims if any(named(c, t) for t in truths)]
    found = [t for t in truths if any(named(c, t) for c in claims)]
    row.false_claims = len(claims) - len(right)
    row.class_size = max((1 + len(c["equivalents"]) for c in right), default=0)
    if row.false_claims or len(right) > len(found):
        row.outcome = "wrong"
    elif len(found) == len(truths):
        row.outcome = "right"
    else:
        row.outcome = "half" if found else "missed"


def _outside(row: Row, report: Report, hidden: Hidden, kind: Outside) -> None:
    false = [c for c in report["effects"] if c["family"] not in kind.near]
    flagged = report["verdict"] in ("unexplained", "partly explained")
    row.false_claims = len(false)
    row.coordinate = str((report["unexplained"] or {}).get("coordinate", "")) if flagged else ""
    if false:
        row.outcome = "wrong"
    elif not flagged:
        row.outcome = "silent"
    else:
        wanted = kind.coordinate(hidden)
        at = row.coordinate.split(" ")[0]
        row.outcome = "right" if at == wanted or at.startswith(f"{wanted}:") else "elsewhere"


def estimates(report: Report, hidden: Hidden) -> list[Estimate]:
    """Parameters of the effects that are claimed by their own name; fixed ones are left out."""
    out = []
    for truth in parts(hidden):
        place = set(truth.where)
        for claim in report["effects"]:
            at = {claim["where"]} if isinstance(claim["where"], str) else set(claim["where"])
            if claim["family"] != truth.family or at != place:
                continue
            for name, true in _alike(truth, claim["parameters"]).items():
                found = claim["parameters"].get(name)  # an effect with values of its own at each place has other names
                if found and found["high"] > found["low"] and not _fixed(found):
                    rest = (found["value"], found["low"], found["high"])
                    out.append(Estimate(f"{truth.family}.{name}", found["unit"], float(true), *rest))
    return out


def _alike(truth: Hidden, told: Mapping[str, Mapping[str, float]]) -> Mapping[str, float]:
    """True values in a claim's own terms: what a drive fades by is told at the claim's reference command."""
    if truth.family != "thermal" or "reference" not in told:
        return truth.parameters
    share = told["reference"]["value"] / truth.parameters["reference"]
    return {**truth.parameters, "fade": truth.parameters["fade"] * share**2}


def _fixed(found: Mapping[str, Any]) -> bool:
    """Whether a parameter only names a reference: its bounds leave it a thousandth either way."""
    if found.get("given"):
        return True
    return found["high"] - found["low"] < 2.5e-3 * abs(found["value"]) and found["unit"] == "V"


def psi_estimates(report: Report, psi: Mapping[str, float], weighed: str) -> list[Estimate]:
    """The model's own free parameters that the logs show."""
    return [
        Estimate(p["name"], p["unit"], psi[p["name"]], p["estimate"], p["low"], p["high"])
        for p in report["parameters"]
        if p["name"] != weighed and p["identifiable"]
    ]


def misses_foretold(report: Report, hidden: Hidden, known: Sequence[tuple[Effect, Array]]) -> bool | None:
    """Whether the table foretells each hidden effect that no claim names; None where all are named.

    Args:
      report: the loop's.
      hidden: what the machine hides.
      known: the library's own effects for it, with their true parameters, in the order of its parts.
    """
    unnamed = [k for k, t in zip(known, parts(hidden), strict=True) if not any(named(c, t) for c in report["effects"])]
    return all(foretold(report, *k) for k in unnamed) if unnamed else None


def foretold(report: Report, truth: Effect, theta: Array) -> bool:
    """Whether the identifiability table says beforehand that an effect would be missed, or taken for another.

    So it is where the true size lies below the table's smallest detectable one, or a claim is its worst mimic. An
    effect of several parameters of one unit (a slope, a push) is as large as their norm.
    """
    rows = [r for r in report["identifiability"] if r["id"] == truth.id]
    if not rows:
        return False
    first = next(p for p in truth.params if not p.shape)
    alike = [i for i, p in enumerate(truth.params) if not p.shape and p.unit == first.unit]
    size = float(np.linalg.norm([theta[i] - truth.params[i].null for i in alike]))
    least = rows[0]["smallest_detectable"]
    claimed = {i for c in report["effects"] for i in (c["id"], *c["equivalents"])}
    return least is None or size < least or rows[0]["worst_mimic"] in claimed


def share_within(values: Sequence[Estimate], most: float) -> tuple[int, int]:
    """(how many are within a relative error, of how many)."""
    off = np.array([e.off for e in values])
    off = off[np.isfinite(off)]
    return int((off <= most).sum()), len(off)
