"""`close_loop`: measured logs in; calibrated parameters, named effects, errors before and after, a corrected model."""

import json
import time
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml
from numpy.typing import NDArray
from rich.console import Console

from nfc_gym.core.errors import InputError
from nfc_gym.core.files import require_writable, write_together
from nfc_gym.core.log import Log
from nfc_gym.measured import verdict as say
from nfc_gym.measured.advice import advise
from nfc_gym.measured.arena import Data
from nfc_gym.measured.bench import Bench, candidates, make_bench
from nfc_gym.measured.checks import require
from nfc_gym.measured.contest import dispersion
from nfc_gym.measured.dataset import Dataset
from nfc_gym.measured.details import details
from nfc_gym.measured.export import corrected, effects_of, pack
from nfc_gym.measured.fisher import Lens
from nfc_gym.measured.fit import Fit, stand
from nfc_gym.measured.identify import table
from nfc_gym.measured.kept import pack_state, unpack_state
from nfc_gym.measured.maps import maps
from nfc_gym.measured.metric import metric
from nfc_gym.measured.model import model_path
from nfc_gym.measured.numerics import fingerprint, one_blas_thread
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.questions import Present, blocks_for
from nfc_gym.measured.remarks import on_parameters
from nfc_gym.measured.report import render, render_summary
from nfc_gym.measured.search import Found, Options, Search, State
from nfc_gym.measured.settle import TURNS, settle, slack
from nfc_gym.measured.splits import Fold
from nfc_gym.measured.stages import Stages, digest, require_free, written_by
from nfc_gym.measured.stakes import Stakes
from nfc_gym.measured.unexplained import unexplained
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
      overwrite: replace an earlier run's results, once there are new ones.
      resume: go on from the last finished stage of an interrupted run.
      fold: only this fold.
      console: where progress goes; None is silent.

    Returns:
      The report, as written to `report.json`.

    Raises:
      InputError: the mapping, the model, the logs or `out` cannot be used; nothing is written then.
    """
    require_writable(out)
    with one_blas_thread():
        return _close_loop(mapping, out, seed, jobs, overwrite, resume, fold, console)


def _close_loop(
    mapping: Path,
    out: Path,
    seed: int,
    jobs: int,
    overwrite: bool,
    resume: bool,
    fold: str | None,
    console: Console | None,
) -> dict[str, Any]:
    # Candidates at the edge of what a model bears may be unstable: that is counted, not printed a thousand times.
    mujoco.set_mju_user_warning(lambda message: None)
    dataset = require(mapping)[0]
    bench = make_bench(dataset, jobs)
    _require_stable(bench)
    key = _key(bench, mapping, seed)
    folds = [dataset.fold(fold)] if fold is not None else list(dataset.folds)
    if len(dataset.folds) == 1:
        return _fold(bench, dataset, folds[0], out, seed, key, overwrite, resume, console)
    if fold is not None:  # other folds may be running beside this one; the summary is the whole run's
        return _fold(bench, dataset, folds[0], out / fold, seed, digest(extra=key + fold), overwrite, resume, console)
    require_free(out, key, overwrite, own=[f.name for f in folds])
    keys = {f.name: digest(extra=key + f.name) for f in folds}

    def finished(f: Fold, of: Container[str]) -> bool:
        """By this run, or by a single fold's run beside it; what an earlier run left is no answer where it goes."""
        known = resume and (f.name in of or not overwrite) and written_by(out / f.name, keys[f.name])
        return known and (out / f.name / "report.json").exists()

    for f in folds:
        if not finished(f, ()):
            require_free(out / f.name, keys[f.name], overwrite)
    stages = Stages(out, key, overwrite, resume, own=[f.name for f in folds])
    done: list[str] = stages.get("folds") or []
    reports = {}
    for f in folds:
        if console:
            console.print(f"[bold]fold {f.name}[/bold] ({len(reports) + 1} of {len(folds)})")
        if finished(f, done):
            reports[f.name] = json.loads((out / f.name / "report.json").read_text(encoding="utf-8"))
        else:
            reports[f.name] = _fold(bench, dataset, f, out / f.name, seed, keys[f.name], overwrite, resume, console)
        done = [*done, f.name]
        stages.put("folds", done)
    summary = _summary(dataset, reports)
    write_together(out, {"report.html": render_summary(summary), "report.json": json.dumps(summary, indent=1)})
    stages.finish()
    return summary


def _key(bench: Bench, mapping: Path, seed: int) -> str:
    """Digest of all that a report depends on: mapping, model with what it includes, logs, splits, seed, versions."""
    dataset = bench.dataset
    splits = [[f.name, dict(f.splits)] for f in dataset.folds]
    versions = [version(p) for p in ("nfc_gym", "mujoco", "numpy", "scipy")]
    model = model_path(dataset.mapping.model_file, dataset.folder)
    extra = json.dumps([seed, versions, splits, fingerprint(bench.plant.model)])
    return digest(mapping, model, *dataset.files, extra=extra)


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
    stages.finish()
    tell(
        f"[bold]{report['verdict']}[/bold]: "
        + ("; ".join(e["sentence"] for e in report["effects"]) or "no effect claimed")
    )
    if report["unexplained"]:
        tell(
            f"[bold]UNEXPLAINED[/bold] at {report['unexplained']['coordinate']}: {report['unexplained']['description']}"
        )
    for finding in report["findings"]:
        tell(finding["text"])
    return report


def _calibrate(run: _Run, problem: Problem) -> Array:
    """(d,) psi, fitted alone."""
    plant = run.bench.plant
    tick = lambda turn: run.say(f"calibrating psi, pass {turn} of at most {TURNS}")  # noqa: E731
    sigma = problem.covariance(plant, plant.null)
    return settle(problem, sigma, plant, plant.null, run.seed, tick=tick)[0].x


def _search(run: _Run, fitting: Any, work: Problem, select: Problem) -> Found:
    """Calibrate, then search; a stage after calibration and after every round. A resumed run goes on from the last."""
    bench, plant = run.bench, run.bench.plant
    run.say(f"{len(work)} segments to fit, {len(select)} to select on")
    # A stage is read back from what is kept of it, just now or by an earlier process: both go on from the same bits.
    if run.stages.get("calibrated") is None:
        run.stages.put("calibrated", {"x": _calibrate(run, work).tolist()})
    x = np.array(run.stages.get("calibrated")["x"], float)
    sigma = work.covariance(plant, x)
    calibrated = stand(work, metric(work, sigma), plant, x)
    pool = candidates(bench, fitting)
    data = Data(work, sigma), Data(select, select.covariance(plant, x))
    search = Search(*data, pool, Options(seed=run.seed), run.say)
    if run.stages.get("found") is None:
        _keep_found(run.stages, _hunt(run, search, calibrated, pool))
    kept = run.stages.get("found")
    state = unpack_state(kept, plant, pool)
    assert state is not None  # every effect that was found is one of the pool's
    under = metric(work, sigma, np.array(kept["slack"], float))
    extended = stand(work, under, state.plant, state.x)
    names = {name: kept[name] for name in ("generic", "nearest", "dropped")}
    found = Found(calibrated, extended, np.array(kept["slack"], float), list(state.rounds), **names)
    found.rest = search.rest(found)
    return found


def _hunt(run: _Run, search: Search, calibrated: Fit, pool: list[Effect]) -> Found:
    """The search, from where it was interrupted if it was."""
    saved = run.stages.get("search")
    begun = unpack_state(saved, run.bench.plant, pool) if saved else None
    if begun:
        run.say(f"going on after {len(begun.rounds)} rounds of the search")
    return search.run(calibrated, begun, lambda state: run.stages.put("search", pack_state(state)))


def _keep_found(stages: Stages, found: Found) -> None:
    state = State(found.extended.plant, found.extended.x, tuple(found.rounds))
    names = {"generic": found.generic, "nearest": found.nearest, "dropped": found.dropped}
    stages.put("found", pack_state(state) | {"slack": found.slack.tolist()} | names)


def _final(run: _Run, found: Found, whole: Problem) -> tuple[Fit, Fit]:
    """Calibrated and extended model refitted on every fit segment."""
    out = []
    assert found.rest is not None
    for name, start in (("calibrated", found.calibrated), ("extended", found.rest.fitted)):
        sigma = whole.covariance(start.plant, start.x)
        if run.stages.get(f"final {name}") is None:
            run.say(f"fitting the {name} model on all {len(whole)} segments")
            fitted, _, extra = settle(whole, sigma, start.plant, start.x)
            run.stages.put(f"final {name}", {"x": fitted.x.tolist(), "slack": extra.tolist()})
        kept = {k: np.array(v, float) for k, v in run.stages.get(f"final {name}").items()}
        out.append(stand(whole, metric(whole, sigma, kept["slack"]), start.plant, kept["x"]))
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
    run: _Run, dataset: Dataset, fold: Fold, found: Found, final: tuple[Fit, Fit], problem: Problem, whole: Problem
) -> dict[str, Any]:
    calibrated, extended = final
    rng = np.random.default_rng(run.seed)
    nominal = (run.bench.plant, run.bench.plant.null)
    models = say.Models(nominal, (calibrated.plant, calibrated.x), (extended.plant, extended.x))
    run.say(f"verifying on {len(problem)} segments")
    v = say.verify(problem, models, _REPLICAS, rng)
    shares = say.excess_shares(v, problem, extended, models.calibrated)
    rows = say.effect_rows(extended, found.rounds, whole, shares)
    laws = {e.id for e in extended.plant.effects if e.generic}
    claimed, proposed = ([r for r in rows if (r["id"] in laws) == law] for law in (False, True))
    verdict = say.verdict(v, len(claimed), found.generic is not None or bool(proposed))
    left = verdict in ("unexplained", "partly explained")
    assert found.rest is not None
    parameters = say.parameter_rows(extended, nominal[1], whole)
    splits = {s: [log.name for log in dataset.of(s, fold)] for s in ("fit", "select", "verify")}
    return {
        "schema": 1,
        "model": dataset.mapping.model_file,
        "fold": fold.name,
        "logs": splits,
        "independent_splits": dataset.independent_splits,
        "parameters": parameters,
        "effects": claimed,
        "proposals": proposed,
        "verdict": verdict,
        "unexplained": unexplained(v, found, extended.plant, proposed) if left else None,
        "error": say.errors(v),
        "chi2": {stage: v.chi2(stage) for stage in v.residual}
        | {
            "null": float(v.null.mean()),
            "null_95": say.null_bound(v),
            "extended_over_calibrated_95": say.gain_interval(v, rng),
        },
        "identifiability": [],
        "findings": on_parameters(extended, parameters),
        "rounds": [r.__dict__ for r in (*found.rounds, *found.rest.rounds)],
        "noise": _noise(run.bench, dataset, fold),
        "details": details(run.bench, v, models, dataset.of("verify", fold))
        | ({"maps": maps(v, extended.plant.model, found.rest.scanned, ("calibrated", "extended"))} if left else {}),
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
    """All outputs or none; `report.json` last, since it marks a finished run."""
    calibrated, extended = final
    xml, outside = corrected(bench.spec, extended.plant, extended.x)
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
