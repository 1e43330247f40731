"""What a run gives out: the report, the summary over folds, and the files."""

import json
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml
from numpy.typing import NDArray

from nfc_gym.core.files import write_together
from nfc_gym.measured import verdict as say
from nfc_gym.measured.bench import Bench
from nfc_gym.measured.details import details
from nfc_gym.measured.distances import Model
from nfc_gym.measured.export import corrected, effects_of, pack
from nfc_gym.measured.fit import Fit
from nfc_gym.measured.maps import maps
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.remarks import on_parameters, on_simplicity
from nfc_gym.measured.report import render
from nfc_gym.measured.search import Found
from nfc_gym.measured.splits import Fold
from nfc_gym.measured.stages import digest
from nfc_gym.measured.unexplained import unexplained

Array = NDArray[np.float64]
_REPLICAS = 20  # of a machine that is exactly the extended model; the bound that six give is largely chance


def report(
    bench: Bench,
    fold: Fold,
    found: Found,
    final: tuple[Model, Fit],
    left_open: say.Open,
    verifying: Problem,
    fitting: Problem,
    seed: int,
    tell: Callable[[str], None],
) -> dict[str, Any]:
    """The report of a fold, without identifiability and advice, and with `details` for its pictures.

    Args:
      bench: the mapping made ready.
      found: what the search found.
      final: calibrated and extended model.
      left_open: what search and physics step leave open of the extended model's parameters.
      verifying, fitting: the logs that nobody saw, and those that the final models were fitted to.
      seed: of the draws.
      tell: progress.
    """
    dataset, (calibrated, extended) = bench.dataset, final
    rng = np.random.default_rng(seed)
    nominal = (bench.plant, bench.plant.null)
    models = say.Models(nominal, (calibrated.plant, calibrated.x), (extended.plant, extended.x))
    tell(f"verifying on {len(verifying)} segments")
    v = say.verify(verifying, models, _REPLICAS, rng)
    shares = say.excess_shares(v, verifying, extended, models.calibrated)
    within = say.bounds(extended, fitting, left_open)
    rows = say.effect_rows(extended, found.rounds, within, shares)
    errors = say.errors(v)
    laws = {e.id for e in extended.plant.effects if e.generic}
    gain = say.gain_interval(v, rng)
    judged = _judge(v, rows, laws, found, errors, gain, say.nought(extended, within))
    left = judged.verdict in ("unexplained", "partly explained")
    assert found.rest is not None
    parameters = say.parameter_rows(extended, nominal[1], within)
    splits = {s: [log.name for log in dataset.of(s, fold)] for s in ("fit", "select", "verify")}
    return {
        "schema": 1,
        "model": dataset.mapping.model_file,
        "fold": fold.name,
        "logs": splits,
        "independent_splits": dataset.independent_splits,
        "parameters": parameters,
        "effects": judged.claimed,
        "proposals": [*judged.weak, *judged.laws],
        "verdict": judged.verdict,
        "unexplained": unexplained(v, found, extended.plant, judged.laws, judged.weak, judged.share) if left else None,
        "error": errors,
        "chi2": {stage: v.chi2(stage) for stage in v.residual}
        | {
            "null": float(v.null.mean()),
            "null_95": say.null_bound(v),
            "extended_over_calibrated_95": gain,
        },
        "identifiability": [],
        "findings": [
            *({"kind": "check", "text": f"{w}."} for w in bench.warned),
            *on_parameters(extended, parameters),
            *on_simplicity(judged.claimed, found.rounds),
        ],
        "rounds": [r.__dict__ for r in (*found.rounds, *found.rest.rounds)],
        "noise": _noise(bench, fold),
        "details": details(bench, v, models, dataset.of("verify", fold))
        | ({"maps": maps(v, extended.plant.model, found.rest.scanned, ("calibrated", "extended"))} if left else {}),
        "seed": seed,
        "versions": {"nfc_gym": version("nfc_gym"), "mujoco": mujoco.__version__},
    }


_CLEAR = 0.9  # of the calibrated model's chi-squared: what must be left at most where even that is less than noise


@dataclass(frozen=True)
class _Judged:
    """The verdict, and what becomes of the rows of effects that were found.

    Attributes:
      claimed: causes.
      weak: named effects that are not shown to be the cause: they take away too little of what is missing, or others
        would nearly as much.
      laws: proposed laws.
      taken: share of the error beyond the noise that all of them take away together.
    """

    verdict: str
    claimed: list[dict[str, Any]]
    weak: list[dict[str, Any]]
    laws: list[dict[str, Any]]
    taken: float

    @property
    def share(self) -> float:
        """What the weak ones explain: all that is taken away, but beside causes what comes back without them."""
        return max((r["share_of_excess"] for r in self.weak), default=0.0) if self.claimed else self.taken


def _judge(
    v: say.Verified,
    rows: Sequence[dict[str, Any]],
    laws: Container[str],
    found: Found,
    errors: dict[str, Any],
    gain: tuple[float, float],
    nought: Container[str] = (),
) -> _Judged:
    """Divide what was found into causes and proposals; `laws` are the ids of those without a name.

    See `doubt` for what leads its rivals by too little, `form` for what has another's form. `gain` is the interval of
    what is left of the calibrated model's chi-squared: where nothing is missing that the unseen logs show, and what was
    found may well make no difference there, it is the cause of nothing. `nought` are effects whose sizes may be none.
    """
    named, proposed = ([r for r in rows if (r["id"] in laws) == law] for law in (False, True))
    generic = found.generic is not None or bool(proposed)
    calibrated, bound = v.chi2("calibrated"), say.null_bound(v)
    # Where less is left than the declared noise would leave, smoothing and rounding have a say in what mends it.
    most = _CLEAR if calibrated < 2 * float(v.null.mean()) - bound else 1.0
    seen = gain[1] < most or calibrated > bound
    verdict, taken = say.verdict(v, len(named) if seen else 0, generic and seen), say.taken_away(v, errors)
    # What is weak predicts, and stays in the model; that it is the cause of what is missing is not shown.
    every: list[dict[str, Any]] = [r | {"nearest": True, "alike": found.doubted.get(r["id"], [])} for r in named]
    if not seen:
        return _Judged(verdict, [], every, proposed, taken)
    if verdict != "partly explained":
        return _Judged(verdict, named, [], proposed, taken)
    every = [r | ({"mended_by": by} if (by := found.misshapen.get(r["id"])) else {}) for r in every]
    every = [r | ({"may_be_none": True} if r["id"] in nought else {}) for r in every]
    guesses = every if taken < say.CAUSE else [r for r in every if r["alike"] or "mended_by" in r]
    # What mends nothing on the unseen logs has mended what the fit left of another law; so has what may have no size.
    weak = [r for r in every if r in guesses or r["share_of_excess"] <= 0 or "may_be_none" in r]
    causes = [r for r in named if r["id"] not in {w["id"] for w in weak}]
    # Beside guesses, what is no guess must itself bring the half: a small law that had no rival is not the cause.
    if guesses and sum(r["share_of_excess"] for r in causes) < say.CAUSE:
        weak, causes = every, []
    return _Judged(verdict if causes else "unexplained", causes, weak, proposed, taken)


def _noise(bench: Bench, fold: Fold) -> list[dict[str, Any]]:
    """Noise of each channel and whether it was declared or estimated."""
    from nfc_gym.measured.states import channel_noise

    log = bench.dataset.of("fit", fold)[0]
    return [
        {"channel": k, "noise": channel_noise(log, k), "unit": c.unit, "estimated": c.noise is None}
        for k, c in log.channels.items()
    ]


def write(out: Path, bench: Bench, final: tuple[Model, Fit], report: dict[str, Any]) -> None:
    """All outputs or none; `report.json` last, since it marks a finished run."""
    calibrated, extended = final
    firmware = [c.removeprefix("ctrl:") for c in bench.firmware]
    xml, outside = corrected(bench.spec, extended.plant, extended.x, out, firmware)
    rows = {e["id"]: e for e in report["effects"]} | {e["id"]: {**e, "proposal": True} for e in report["proposals"]}
    listed = [rows[e.id] for e, _ in effects_of(extended.plant, extended.x, outside)]
    effects = {
        "version": 1,
        "model_sha256": digest(extra=xml),
        "effects": listed,
        "carried_by_model": [i for i in rows if i not in {e["id"] for e in listed}],
    }
    packed = {"nominal": {"psi": {}, "effects": []}, "calibrated": pack(calibrated), "extended": pack(extended)}
    shown = report.pop("details")
    texts = {
        "model.xml": xml,
        "effects.yaml": yaml.safe_dump(effects, sort_keys=False, allow_unicode=True),
        "fit.json": json.dumps({"fold": report["fold"], **packed}, indent=1),
        "report.html": render(report, shown),
        "report.json": json.dumps(report, indent=1),
    }
    write_together(out, texts)


def summary(reports: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """One report over the folds: the effects that each found; the first fold's own report carries the rest."""
    first = next(iter(reports.values()))
    counts: dict[str, int] = {}
    for r in reports.values():
        for e in r["effects"]:
            counts[e["id"]] = counts.get(e["id"], 0) + 1
    keys = ("schema", "model", "seed", "versions")
    return {k: first[k] for k in keys} | {
        "folds": {
            name: {
                "verdict": r["verdict"],
                "effects": [e["id"] for e in r["effects"]],
                "chi2": r["chi2"],
                "error": r["error"],
            }
            for name, r in reports.items()
        },
        "effects_found_in": {
            k: f"{n} of {len(reports)} folds" for k, n in sorted(counts.items(), key=lambda kv: -kv[1])
        },
        "seconds": sum(r["seconds"] for r in reports.values()),
    }
