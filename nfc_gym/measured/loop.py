"""`close_loop`: measured logs in; calibrated parameters, named effects, errors before and after, a corrected model."""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml
from numpy.typing import NDArray
from rich.console import Console

from nfc_gym.core.errors import InputError
from nfc_gym.core.log import Log
from nfc_gym.measured import verdict as say
from nfc_gym.measured.advice import advise
from nfc_gym.measured.arena import Data
from nfc_gym.measured.bench import Bench, candidates, make_bench
from nfc_gym.measured.checks import require
from nfc_gym.measured.contest import dispersion
from nfc_gym.measured.dataset import Dataset
from nfc_gym.measured.details import details
from nfc_gym.measured.export import corrected, effects_of, pack, unpack
from nfc_gym.measured.fisher import Lens
from nfc_gym.measured.fit import Fit, fit
from nfc_gym.measured.identify import table
from nfc_gym.measured.metric import metric
from nfc_gym.measured.model import model_path
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.questions import Present, blocks_for
from nfc_gym.measured.remarks import on_parameters
from nfc_gym.measured.report import render, render_summary
from nfc_gym.measured.rounds import Round
from nfc_gym.measured.search import Found, Options, Search
from nfc_gym.measured.settle import TURNS, settle, slack
from nfc_gym.measured.splits import Fold
from nfc_gym.measured.stages import Stages, digest, write_whole
from nfc_gym.measured.stakes import Stakes
from nfc_gym.physics.effects.base import Effect

Array = NDArray[np.float64]
_WORK = 16_000  # physics steps of one pass over the fit segments that the search works with; the last fit takes all
_REPLICAS = 6
_SOME_LOGS = 6  # that the identifiability table of an instant problem is made from


@dataclass
class _Run:
    """What the steps of one run share."""

    bench: Bench
    stages: Stages
    seed: int
    say: Callable[[str], None]


def close_loop(
    mapping: Path,
    out: Path,
    *,
    seed: int = 0,
    jobs: int = 0,
    overwrite: bool = False,
    resume: bool = True,
    fold: str | None = None,
    console: Console | None = None,
) -> dict[str, Any]:
    """Close the loop on the logs that a mapping file names.

    Args:
      mapping: the mapping file.
      out: folder for `report.json`, `report.html`, `model.xml`, `effects.yaml`; with `split: {by: rotate}` one folder a
        fold beneath it, and a summary.
      seed: the same inputs and seed give the same report.
      jobs: threads of the roll-outs; 0 takes every core.
      overwrite: replace an earlier run's results.
      resume: go on from the last finished stage of an interrupted run.
      fold: only this fold.
      console: where progress goes; None is silent.

    Returns:
      The report, as written to `report.json`.

    Raises:
      InputError: the mapping, the model or the logs cannot be used; nothing is written then.
    """
    # Candidates at the edge of what a model bears may be unstable: that is counted, not printed a thousand times.
    mujoco.set_mju_user_warning(lambda message: None)
    dataset = require(mapping)[0]
    bench = make_bench(dataset, jobs)
    _require_stable(bench)
    key = digest(
        mapping,
        model_path(dataset.mapping.model_file, dataset.folder),
        *dataset.files,
        extra=f"{seed} {version('nfc_gym')}",
    )
    folds = [dataset.fold(fold)] if fold is not None else list(dataset.folds)
    if len(dataset.folds) == 1:
        return _fold(bench, dataset, folds[0], out, seed, key, overwrite, resume, console)
    if fold is None:  # single folds may be running side by side
        Stages(out, key, overwrite, resume)
    reports = {}
    for f in folds:
        if console:
            console.print(f"[bold]fold {f.name}[/bold] ({len(reports) + 1} of {len(folds)})")
        finished = out / f.name / "report.json"
        if finished.exists() and resume and not overwrite:
            reports[f.name] = json.loads(finished.read_text())
            continue
        reports[f.name] = _fold(
            bench, dataset, f, out / f.name, seed, digest(extra=key + f.name), overwrite, resume, console
        )
    if fold is not None:  # other folds may be running beside this one; the summary is the whole run's
        return reports[fold]
    summary = _summary(dataset, reports)
    write_whole(out / "report.html", render_summary(summary))
    write_whole(out / "report.json", json.dumps(summary, indent=1))
    return summary


def _require_stable(bench: Bench) -> None:
    """Raises `InputError` where the model as given diverges on every segment: no fit can begin there."""
    problem = bench.problem(bench.dataset.of("fit"), most=40)
    residual = problem.residual(bench.plant, bench.plant.null[None])
    if not np.isfinite(residual).all(-1).any():
        raise InputError(
            f"model {bench.dataset.mapping.model_file}: the simulation is unstable on every segment that was tried, at "
            f"a step of {bench.plant.model.opt.timestep:g} s; shorten segments.timestep, or check gains and units"
        )


def _summary(dataset: Dataset, reports: dict[str, dict[str, Any]]) -> dict[str, Any]:
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


def _fold(
    bench: Bench,
    dataset: Dataset,
    fold: Fold,
    out: Path,
    seed: int,
    key: str,
    overwrite: bool,
    resume: bool,
    console: Console | None,
) -> dict[str, Any]:
    began = time.monotonic()
    stages = Stages(out, key, overwrite, resume)

    def tell(text: str) -> None:
        if console:
            console.print(f"[dim]{time.monotonic() - began:6.1f} s[/dim]  {text}")

    run = _Run(bench, stages, seed, tell)
    fitting, selecting, verifying = (dataset.of(s, fold) for s in ("fit", "select", "verify"))
    if not verifying:
        raise InputError("no log verifies: give one `split: verify`, or let `split` divide them")
    # What was selected is refitted on all logs that do not verify.
    whole = bench.problem([*fitting, *selecting])
    steps = bench.dataset.mapping.segments.length / bench.plant.model.opt.timestep
    work = bench.problem(fitting, most=max(40, int(_WORK / steps)))
    select = bench.problem(selecting, most=max(40, int(_WORK / steps)))
    found = _search(run, fitting, work, select)
    final = _final(run, found, whole)
    pool = candidates(bench, [*fitting, *selecting])
    known = _identify(run, final[1], [*fitting, *selecting], [work, select], pool)
    report = _report(run, dataset, fold, found, final, bench.problem(verifying), whole)
    report["identifiability"] = table(known.lens, pool, known.stakes)
    advice = advise(bench, [*fitting, *selecting], report, known, tell, seed)
    report["identifiability"] = advice.rows
    report["findings"] += advice.findings
    report["seconds"] = round(time.monotonic() - began, 1)
    _write(out, bench, final, report)
    tell(
        f"[bold]{report['verdict']}[/bold]: "
        + ("; ".join(e["sentence"] for e in report["effects"]) or "no effect claimed")
    )
    for finding in report["findings"]:
        tell(finding["text"])
    return report


def _calibrate(run: _Run, problem: Problem) -> tuple[Fit, Array]:
    """Psi alone, and the noise covariance there."""
    plant = run.bench.plant
    tick = lambda turn: run.say(f"calibrating psi, pass {turn} of at most {TURNS}")  # noqa: E731
    sigma = problem.covariance(plant, plant.null)
    fitted, _, _ = settle(problem, sigma, plant, plant.null, run.seed, tick=tick)
    return fitted, problem.covariance(plant, fitted.x)


def _search(run: _Run, fitting: Any, work: Problem, select: Problem) -> Found:
    """Calibrate, then search; a stage after calibration and after every round. A resumed run goes on from the last."""
    bench, plant = run.bench, run.bench.plant
    run.say(f"{len(work)} segments to fit, {len(select)} to select on")
    done = run.stages.get("calibrated")
    start = plant.space.vector(done["psi"]) if done else plant.null
    if done:
        sigma = work.covariance(plant, start)
        calibrated = fit(work, metric(work, sigma, slack(work, sigma, plant, start)), plant, start, rounds=1)
    else:
        calibrated, sigma = _calibrate(run, work)
        run.stages.put("calibrated", pack(calibrated))
    pool = candidates(bench, fitting)
    data = Data(work, sigma)
    search = Search(data, Data(select, select.covariance(plant, calibrated.x)), pool, Options(seed=run.seed), run.say)
    saved = run.stages.get("search")
    begun = None
    if saved:
        grown, x = unpack(saved["model"], plant)
        rounds = [Round(**r) for r in saved["rounds"]]
        begun = (Fit(grown, x, calibrated.white, calibrated.jacobian), rounds)
        run.say(f"going on after {len(rounds)} rounds of the search")
    return search.run(
        calibrated,
        begun,
        lambda current, rounds: run.stages.put(
            "search", {"model": pack(current), "rounds": [asdict(r) for r in rounds]}
        ),
    )


def _final(run: _Run, found: Found, whole: Problem) -> tuple[Fit, Fit]:
    """Calibrated and extended model refitted on every fit segment."""
    done = run.stages.get("final")
    out = []
    for name, start in (("calibrated", found.calibrated), ("extended", found.extended)):
        plant, x = unpack(done[name], run.bench.plant) if done else (start.plant, start.x)
        sigma = whole.covariance(plant, x)
        run.say(f"fitting the {name} model on all {len(whole)} segments")
        if done:
            out.append(fit(whole, metric(whole, sigma, slack(whole, sigma, plant, x)), plant, x, rounds=1))
        else:
            out.append(settle(whole, sigma, plant, x)[0])
    run.stages.put("final", {"calibrated": pack(out[0]), "extended": pack(out[1])})
    return out[0], out[1]


def _identify(
    run: _Run, fitted: Fit, logs: Sequence[Log], searched: Sequence[Problem], pool: Sequence[Effect]
) -> Present:
    """The logs that the search worked with, seen from the fitted model, and what it charged."""
    run.say("what these logs could have shown")
    bench, plant = run.bench, fitted.plant
    # An instant problem evaluates whole logs: some of them must do.
    some = logs if bench.mode == "rollout" else logs[:: -(-len(logs) // _SOME_LOGS)]
    problem = bench.problem(some, most=blocks_for(len(pool)))
    sigma = problem.covariance(plant, fitted.x)
    lens = Lens(problem, metric(problem, sigma, slack(problem, sigma, plant, fitted.x)), plant, fitted.x)
    count = sum(int(p.mask.sum()) for p in searched)
    repeats = sum(map(len, searched)) / len(problem)
    return Present(lens, repeats, Stakes(count, dispersion(fitted), Options().worth, repeats))


def _report(
    run: _Run,
    dataset: Dataset,
    fold: Fold,
    found: Found,
    final: tuple[Fit, Fit],
    problem: Problem,
    whole: Problem,
) -> dict[str, Any]:
    calibrated, extended = final
    rng = np.random.default_rng(run.seed)
    nominal = (run.bench.plant, run.bench.plant.null)
    models = say.Models(nominal, (calibrated.plant, calibrated.x), (extended.plant, extended.x))
    run.say(f"verifying on {len(problem)} segments")
    v = say.verify(problem, models, _REPLICAS, rng)
    verdict = say.verdict(v, len(extended.plant.effects), found.generic is not None)
    shares = say.excess_shares(v, problem, extended, models.calibrated)
    splits = {s: [log.name for log in dataset.of(s, fold)] for s in ("fit", "select", "verify")}
    parameters = say.parameter_rows(extended, nominal[1], whole)
    return {
        "schema": 1,
        "model": dataset.mapping.model_file,
        "fold": fold.name,
        "logs": splits,
        "independent_splits": dataset.independent_splits,
        "parameters": parameters,
        "effects": say.effect_rows(extended, found.rounds, whole, shares),
        "verdict": verdict,
        "unexplained": say.unexplained(v, found) if verdict in ("unexplained", "partly explained") else None,
        "error": say.errors(v),
        "chi2": {stage: v.chi2(stage) for stage in v.residual}
        | {
            "null": float(v.null.mean()),
            "null_95": say.null_bound(v),
            "extended_over_calibrated_95": say.gain_interval(v, rng),
        },
        "identifiability": [],
        "findings": on_parameters(extended, parameters),
        "rounds": [r.__dict__ for r in found.rounds],
        "noise": _noise(run.bench, dataset, fold),
        "details": details(run.bench, v, models, dataset.of("verify", fold)),
        "seed": run.seed,
        "versions": {"nfc_gym": version("nfc_gym"), "mujoco": mujoco.__version__},
    }


def _noise(bench: Bench, dataset: Dataset, fold: Fold) -> list[dict[str, Any]]:
    """Noise of each channel and whether it was declared or estimated."""
    from nfc_gym.measured.states import channel_noise

    log = dataset.of("fit", fold)[0]
    return [
        {"channel": k, "noise": channel_noise(log, k), "unit": c.unit, "estimated": c.noise is None}
        for k, c in log.channels.items()
    ]


def _write(out: Path, bench: Bench, final: tuple[Fit, Fit], report: dict[str, Any]) -> None:
    """All outputs, each whole or not at all; `report.json` last, since it marks a finished run."""
    calibrated, extended = final
    xml, outside = corrected(bench.spec, extended.plant, extended.x)
    write_whole(out / "model.xml", xml)
    rows = {e["id"]: e for e in report["effects"]}
    listed = [rows[e.id] for e, _ in effects_of(extended.plant, extended.x, outside)]
    effects = {
        "version": 1,
        "model_sha256": digest(out / "model.xml"),
        "effects": listed,
        "carried_by_model": [i for i in rows if i not in {e["id"] for e in listed}],
    }
    write_whole(out / "effects.yaml", yaml.safe_dump(effects, sort_keys=False, allow_unicode=True))
    packed = {"nominal": {"psi": {}, "effects": []}, "calibrated": pack(calibrated), "extended": pack(extended)}
    write_whole(out / "fit.json", json.dumps({"fold": report["fold"], **packed}, indent=1))
    shown = report.pop("details")
    write_whole(out / "report.html", render(report, shown))
    write_whole(out / "report.json", json.dumps(report, indent=1))
