"""What a report is worth beside the truth: its verdict, its places, its numbers, its errors before and after."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from standin.row import Estimate

from .running import TIMED_OUT

Claim = tuple[str, frozenset[str]]
FLAGGED = ("unexplained", "partly explained")
VECTORS = ({"x", "y", "z"}, {"cosine", "sine"}, {"roll", "pitch"})  # components whose error is over their length
LEFT_OUT = ("failed", "timed out")


@dataclass
class Number(Estimate):
    """A number of the truth as a report tells it; `length` is that of the vector that it is a component of."""

    length: float = 0.0

    @property
    def off(self) -> float:
        """Error over the true number, or over the vector's length."""
        whole = self.length or abs(self.true)
        return abs(self.value - self.true) / whole if whole else float("nan")


@dataclass
class Score:
    """One machine.

    Attributes:
      name, group, seed: of the machine; `hidden` says in words what it hides.
      outcome: `right`; else of nulls `claimed` or `unclear` (nothing claimed, yet not called "nothing missing"), of
        effects `wide` (among three or more that cannot be told apart), `half`, `missed` or `wrong`, of those outside
        the library `elsewhere` (a rest at another place), `silent` or `wrong`; of any machine `failed`, `timed out`.
      verdict, claims, said: of the report; `said` is where the rest is.
      x: X of the nominal, the calibrated and the extended model, and of a perfect one (`null`).
      effect, psi: numbers of effects that are claimed by name, and of the model's own parameters.
      seconds, code: of the loop.
      shown: noise deviations by which the plainest channel is off 0.2 s ahead without the effect.
    """

    name: str
    group: str
    seed: int
    hidden: str
    outcome: str = "failed"
    verdict: str = ""
    claims: list[str] = field(default_factory=list)
    said: str = ""
    x: dict[str, float] = field(default_factory=dict)
    effect: list[Number] = field(default_factory=list)
    psi: list[Number] = field(default_factory=list)
    seconds: float = 0.0
    code: int = 0
    shown: float = 0.0

    def plain(self) -> dict[str, Any]:
        """As JSON has it."""
        return asdict(self)


def score(truth: Mapping[str, Any], report: Mapping[str, Any] | None, ending: Mapping[str, Any]) -> Score:
    """One machine's score; without a report it has failed or ran out of time, which is as bad as a wrong answer."""
    hidden = "; ".join(e["text"] for e in truth["effects"]) or "nothing"
    row = Score(truth["name"], truth["group"], truth["seed"], hidden, seconds=ending["seconds"], code=ending["code"])
    row.shown = max(truth["shown"].values(), default=0.0)
    if report is None or ending["code"] != 0:
        row.outcome = "timed out" if ending["code"] == TIMED_OUT else "failed"
        return row
    row.verdict = report["verdict"]
    row.claims = [" = ".join([c["id"], *c["equivalents"]]) for c in report["effects"]]
    row.said = _said(report)
    row.x = {k: report["chi2"][k] for k in ("nominal", "calibrated", "extended", "null")}
    judge = {"null": _null, "outside": _outside}.get(truth["group"], _named)
    row.outcome = judge(truth["effects"], report)
    row.effect, row.psi = _effect_numbers(truth["effects"], report), _psi_numbers(truth["psi"], report)
    return row


def _null(effects: Sequence[Mapping], report: Mapping) -> str:
    if report["effects"]:
        return "claimed"
    return "right" if report["verdict"] == "nothing missing" else "unclear"


def _named(effects: Sequence[Mapping], report: Mapping) -> str:
    """Each true effect by one claim, or by the one equivalent that is reported beside it, and nothing else."""
    left, found, wide = list(report["effects"]), 0, False
    for effect in effects:
        for claim in left:
            names = [_own(claim), *map(_split, claim["equivalents"])]
            if _forms(effect) & set(names):
                found, wide = found + 1, wide or len(names) > 2
                left.remove(claim)
                break
    if left:
        return "wrong"
    if found < len(effects):
        return "half" if found else "missed"
    return "wide" if wide else "right"


def _outside(effects: Sequence[Mapping], report: Mapping) -> str:
    near = set().union(*map(_forms, effects))
    if any(_own(claim) not in near for claim in report["effects"]):
        return "wrong"
    if report["verdict"] not in FLAGGED:
        return "silent"
    words = set(re.findall(r"[\w.-]+", _said(report)))
    return "right" if words & {p for e in effects for p in e["places"]} else "elsewhere"


def _said(report: Mapping) -> str:
    """Where the rest is, in the report's words."""
    rest = report["unexplained"] or {}
    return str(rest.get("coordinate") or "") if report["verdict"] in FLAGGED else ""


def _forms(effect: Mapping) -> set[Claim]:
    return {(f["family"], frozenset(f["where"])) for f in effect["forms"]}


def _own(claim: Mapping) -> Claim:
    where = claim["where"]
    return claim["family"], frozenset([where] if isinstance(where, str) else where)


def _split(effect_id: str) -> Claim:
    """Family and places of an id such as `coulomb:a+b:each`; a channel's own colons stay."""
    family, _, place = effect_id.removesuffix(":each").partition(":")
    return family, frozenset(place.split("+"))


def _effect_numbers(effects: Sequence[Mapping], report: Mapping) -> list[Number]:
    """Parameters of claims that are a true effect by one of its names; of an equivalent there are none."""
    out = []
    for effect in effects:
        for form in effect["forms"]:
            place = form["family"], frozenset(form["where"])
            for claim in (c for c in report["effects"] if _own(c) == place):
                for name, true in form["parameters"].items():
                    told = claim["parameters"].get(name)  # values of its own at each place have other names
                    if told:
                        length = _length(name, form["parameters"])
                        rest = (told["value"], told["low"], told["high"], length)
                        out.append(Number(f"{form['family']}.{name}", told["unit"], true, *rest))
    return out


def _length(name: str, parameters: Mapping[str, float]) -> float:
    for vector in VECTORS:
        if name in vector:
            return float(np.linalg.norm([parameters[n] for n in vector & parameters.keys()]))
    return 0.0


def _psi_numbers(psi: Mapping[str, float], report: Mapping) -> list[Number]:
    """The model's own parameters, of those that the logs show."""
    return [
        Number(p["name"], p["unit"], psi[p["name"]], p["estimate"], p["low"], p["high"])
        for p in report["parameters"]
        if p["identifiable"]
    ]
