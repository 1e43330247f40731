"""`close_loop`: measured logs in; calibrated parameters, named effects, errors before and after, a corrected model."""

import json
import time
from collections.abc import Container, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.text import Text

from nfc_gym.core.errors import InputError
from nfc_gym.core.files import require_writable, write_together
from nfc_gym.core.log import Log
from nfc_gym.measured.advice import advise
from nfc_gym.measured.belief import read_belief
from nfc_gym.measured.bench import Bench, candidates, make_bench
from nfc_gym.measured.calibrate import calibrate, compared
from nfc_gym.measured.checks import require
from nfc_gym.measured.contest import dispersion
from nfc_gym.measured.dataset import Dataset
from nfc_gym.measured.drowned import ADVICE, REASON, drowned
from nfc_gym.measured.final import final_models
from nfc_gym.measured.fisher import Lens
from nfc_gym.measured.fit import Fit, stand
from nfc_gym.measured.identify import table
from nfc_gym.measured.kept import pack_state, unpack_state
from nfc_gym.measured.metric import metric
from nfc_gym.measured.model import model_path
from nfc_gym.measured.numerics import fingerprint, one_blas_thread
from nfc_gym.measured.outcome import report, summary, write
from nfc_gym.measured.owned import Data
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.questions import Present, blocks_for
from nfc_gym.measured.report import render_summary
from nfc_gym.measured.run import Run
from nfc_gym.measured.search import Found, Options, Search, State
from nfc_gym.measured.settle import slack
from nfc_gym.measured.splits import Fold
from nfc_gym.measured.stages import Stages, digest, held, require_free, written_by
from nfc_gym.measured.stakes import Stakes
from nfc_gym.measured.suspects import NONE, Suspects, Witness, ask, kept, looked_at, restored
from nfc_gym.measured.telling import teller, warned
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.quiet import no_warnings
from nfc_gym.physics.untimed import untimed

Array = NDArray[np.float64]
_WORK = 16_000  # physics steps of one pass over the fit segments that the search works with; the last fit takes all
_SOME_LOGS = 6  # that the identifiability table of an instant problem is made from


def close_loop(
    mapping: Path,
    out: Path,
    *,
    seed: int = 0,
    jobs: int = 0,
    overwrite: bool = False,
    resume: bool = True,
    fold: str | None = None,
    posterior: Path | None = None,
    compare: bool = False,
    witness: tuple[Witness, Path] | None = None,
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
      posterior: of psi given a window of this machine's motion (see `belief`): calibration starts from it, and the
        report shows what it inferred beside what was fitted.
      compare: calibrate once more from nominal values, to say how much time the posterior saved.
      witness: a structure head (`simulate.witness`) and its file: the families of effects that it holds possible,
        given the fit logs, are looked at first (see `suspects`), and the report says what it held.
      console: where progress goes; None is silent.

    Returns:
      The report, as written to `report.json`.

    Raises:
      InputError: the mapping, the model, the logs or `out` cannot be used; nothing is written then.
    """
    require_writable(out)
    _require_room(out, overwrite, fold)
    # Candidates at the edge of what a model bears may be unstable: that is counted, not printed a thousand times.
    with one_blas_thread(), untimed(), no_warnings():
        dataset, noticed = require(mapping)
        bench = make_bench(dataset, jobs)
        bench.warned = warned(console, noticed)
        if posterior is not None:
            bench.belief, bench.compare = read_belief(posterior, bench.plant.space, seed), compare
        if witness is not None:
            bench.witness = witness[0], witness[1].name
        _require_stable(bench)
        key = _key(bench, seed, mapping, *([posterior] if posterior else []), *([witness[1]] if witness else []))
        return _close_loop(bench, dataset, out, seed, key, overwrite, resume, fold, console)


def _require_room(out: Path, overwrite: bool, fold: str | None) -> None:
    """Refuse, before the logs are read, what `require_free` would refuse after: a finished run, somebody's files."""
    inside = list(out.iterdir()) if out.is_dir() else []
    folders = [p for p in inside if p.is_dir()]
    if fold:
        folder = next((p for p in folders if p.name == fold), None)
        if folder is not None:
            require_free(folder, None, overwrite)
    else:  # folders may be those of folds, which only the logs tell
        require_free(out, None, overwrite, own=[p.name for p in folders])


def _close_loop(
    bench: Bench,
    dataset: Dataset,
    out: Path,
    seed: int,
    key: str,
    overwrite: bool,
    resume: bool,
    fold: str | None,
    console: Console | None,
) -> dict[str, Any]:
    folds = [dataset.fold(fold)] if fold is not None else list(dataset.folds)
    if len(dataset.folds) == 1:
        with held(out):
            return _fold(bench, dataset, folds[0], out, seed, key, overwrite, resume, console)
    if fold is not None:  # other folds may be running beside this one; the summary is the whole run's
        with held(out / fold):
            own = digest(extra=key + fold)
            return _fold(bench, dataset, folds[0], out / fold, seed, own, overwrite, resume, console)
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
            console.print(Text.assemble((f"fold {f.name}", "bold"), f" ({len(reports) + 1} of {len(folds)})"))
        if finished(f, done):
            reports[f.name] = json.loads((out / f.name / "report.json").read_text(encoding="utf-8"))
        else:
            with held(out / f.name):
                reports[f.name] = _fold(bench, dataset, f, out / f.name, seed, keys[f.name], overwrite, resume, console)
        done = [*done, f.name]
        stages.put("folds", done)
    whole = summary(reports)
    write_together(out, {"report.html": render_summary(whole), "report.json": json.dumps(whole, indent=1)})
    stages.finish()
    return whole


def _key(bench: Bench, seed: int, *files: Path) -> str:
    """Digest of all that a report depends on: files, model with what it includes, logs, splits, seed, versions."""
    dataset = bench.dataset
    splits = [[f.name, dict(f.splits)] for f in dataset.folds]
    versions = [version(p) for p in ("nfc_gym", "mujoco", "numpy", "scipy")]
    model = model_path(dataset.mapping.model_file, dataset.folder)
    extra = json.dumps([seed, versions, splits, fingerprint(bench.plant.model)])
    return digest(*files, model, *dataset.files, extra=extra)


def _require_stable(bench: Bench) -> None:
    """Raises `InputError` where the model as given diverges on every segment: no fit can begin there."""
    problem = bench.problem(bench.dataset.of("fit"), most=40)
    residual = problem.residual(bench.plant, bench.plant.null[None])
    if not np.isfinite(residual).all(-1).any():
        raise InputError(
            f"model {bench.dataset.mapping.model_file}: the simulation is unstable on every segment that was tried, at "
            f"a step of {bench.plant.model.opt.timestep:g} s; shorten segments.timestep, or check gains and units"
        )


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

    tell = teller(console, began)
    run = Run(bench, stages, seed, tell)
    fitting, selecting, verifying = (dataset.of(s, fold) for s in ("fit", "select", "verify"))
    if not verifying:
        raise InputError("no log verifies: give one `split: verify`, or let `split` divide them")
    # What was selected is refitted on all logs that do not verify.
    whole = bench.searched([*fitting, *selecting])
    most = max(40, int(_WORK * bench.plant.model.opt.timestep / dataset.mapping.segments.length))
    work, select = bench.searched(fitting, most), bench.searched(selecting, most)
    found = _search(run, fitting, work, select)
    calibrated, extended, left_open = final_models(run, found, whole)
    final = calibrated, extended
    pool = candidates(bench, [*fitting, *selecting])
    suspects = restored(stages.get("suspects"))
    close = pool if suspects is None else looked_at(pool, suspects, found.rounds)
    known = _identify(run, final[1], [*fitting, *selecting], [work, select], pool)
    outcome = report(bench, fold, found, final, left_open, bench.problem(verifying), whole, seed, tell)
    outcome["posterior"] = compared(bench, stages.get("calibrated"), extended, whole, outcome["parameters"])
    tell(f"what these logs could have shown of {len(close)} candidates")
    began_table = time.monotonic()
    outcome["identifiability"] = table(known.lens, close, known.stakes)
    tabled = time.monotonic() - began_table
    outcome["structure"] = None if suspects is None else suspects.told(close, pool, tabled)
    advice = advise(bench, [*fitting, *selecting], outcome, known, tell, seed)
    outcome["effects"] = advice.effects
    claims = {e["id"] for e in outcome["effects"]}
    outcome["identifiability"] = [row | {"claimed": row["id"] in claims} for row in advice.rows]
    outcome["findings"] += advice.findings
    if found.rounds[-1].reason == REASON:
        outcome["findings"].append({"kind": "advice", "text": ADVICE})
    outcome["seconds"] = round(stages.seconds, 1)
    write(out, bench, final, outcome)
    stages.finish()
    claimed = "; ".join(e["sentence"] for e in outcome["effects"]) or "no effect claimed"
    tell(f": {claimed}", lead=outcome["verdict"])
    if outcome["unexplained"]:
        left = outcome["unexplained"]
        lead, word = ("UNEXPLAINED", "") if outcome["verdict"] == "unexplained" else ("", "left unexplained")
        tell(f"{word} at {left['coordinate']}: {left['description']}", lead=lead)
    for finding in outcome["findings"]:
        if finding["kind"] != "check":  # which was said before all else
            tell(finding["text"])
    return outcome


_TOLD = ("generic", "nearest", "hinted", "dropped", "doubted", "misshapen")  # of `Found`, kept as it is


def _search(run: Run, fitting: Any, work: Problem, select: Problem) -> Found:
    """Calibrate, then search; a stage after calibration and after every round. A resumed run goes on from the last."""
    bench, plant = run.bench, run.bench.plant
    reach = f" of {work.columns.horizon.max():g} s, as far as slopes can follow," if bench.short else ""
    run.say(f"{len(work)} segments{reach} to fit, {len(select)} to select on")
    # A stage is read back from what is kept of it, just now or by an earlier process: both go on from the same bits.
    if run.stages.get("calibrated") is None:
        run.stages.put("calibrated", calibrate(work, plant, run.seed, run.say, bench.belief, bench.compare))
    x = np.array(run.stages.get("calibrated")["x"], float)
    sigma = work.covariance(plant, x)
    under = metric(work, sigma)
    calibrated = stand(work, under, plant, x)
    lost = bench.mode == "rollout" and drowned(work, under, plant, x, run.seed)
    pool = [] if lost else candidates(bench, fitting)
    data = Data(work, sigma, (plant, x)), Data(select, select.covariance(plant, x), (plant, x))
    search = Search(*data, pool, Options(seed=run.seed), run.say, _suspects(run, fitting, x))
    if run.stages.get("found") is None:
        hunted = _hunt(run, search, calibrated, pool)
        if lost:
            hunted.rounds[-1].reason = REASON
        _keep_found(run.stages, hunted)
    kept = run.stages.get("found")
    state = unpack_state(kept, plant, pool)
    assert state is not None  # every effect that was found is one of the pool's
    under = metric(work, sigma, np.array(kept["slack"], float))
    extended = stand(work, under, state.plant, state.x)
    names = {name: kept[name] for name in _TOLD if name in kept}
    found = Found(calibrated, extended, np.array(kept["slack"], float), list(state.rounds), **names)
    found.rest = search.rest(found)
    return found


def _suspects(run: Run, fitting: Sequence[Log], x: Array) -> Suspects | None:
    """What the structure head says of the fit logs and the calibrated model, asked once a run; None without a head."""
    if run.bench.witness is None:
        return None
    if run.stages.get("suspects") is None:
        witness, file = run.bench.witness
        found = ask(witness, file, run.bench, fitting, x, run.seed)
        told = ", ".join(f"{f} {found.probabilities[f]:.2f}" for f in (NONE, *found.likely) if f in found.probabilities)
        run.say(f"{file}, asked about {found.windows} windows: {told}")
        run.stages.put("suspects", kept(found))
    return restored(run.stages.get("suspects"))


def _hunt(run: Run, search: Search, calibrated: Fit, pool: list[Effect]) -> Found:
    """The search, from where it was interrupted if it was."""
    saved = run.stages.get("search")
    begun = unpack_state(saved, run.bench.plant, pool) if saved else None
    if begun:
        run.say(f"going on after {len(begun.rounds)} rounds of the search")
    return search.run(calibrated, begun, lambda state: run.stages.put("search", pack_state(state)))


def _keep_found(stages: Stages, found: Found) -> None:
    state = State(found.extended.plant, found.extended.x, tuple(found.rounds))
    names = {name: getattr(found, name) for name in _TOLD}
    stages.put("found", pack_state(state) | {"slack": found.slack.tolist()} | names)


def _identify(
    run: Run, fitted: Fit, logs: Sequence[Log], searched: Sequence[Problem], pool: Sequence[Effect]
) -> Present:
    """The logs that the search worked with, seen from the fitted model, and what it charged."""
    bench, plant = run.bench, fitted.plant
    # An instant problem evaluates whole logs: some of them must do.
    some = logs if bench.mode == "rollout" else logs[:: -(-len(logs) // _SOME_LOGS)]
    problem = bench.searched(some, blocks_for(len(pool)))
    sigma = problem.covariance(plant, fitted.x)
    lens = Lens(problem, metric(problem, sigma, slack(problem, sigma, plant, fitted.x)), plant, fitted.x)
    count = sum(int(p.mask.sum()) for p in searched)
    repeats = sum(map(len, searched)) / len(problem)
    return Present(lens, repeats, Stakes(count, dispersion(fitted), Options().worth, repeats))
