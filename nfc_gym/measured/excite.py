"""`excite`: commands for the next recording, such that it tells apart what the present logs cannot."""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from nfc_gym.core import units
from nfc_gym.core.errors import InputError
from nfc_gym.core.files import require_writable, write_whole
from nfc_gym.measured import questions
from nfc_gym.measured.bench import Bench, candidates, make_bench
from nfc_gym.measured.checks import require
from nfc_gym.measured.contest import losses
from nfc_gym.measured.design import Design, Tried
from nfc_gym.measured.distances import Distances
from nfc_gym.measured.expected import pair_rows, pair_sentence, size_rows, size_sentence
from nfc_gym.measured.experiment import Stage
from nfc_gym.measured.fit import fit
from nfc_gym.measured.metric import metric
from nfc_gym.measured.proposal_page import render
from nfc_gym.measured.questions import Present, Visible
from nfc_gym.measured.telling import teller, warned
from nfc_gym.physics.quiet import no_warnings

Array = NDArray[np.float64]
_ROUNDS = 8  # iterations of a rival's refit to the simulated recording
_SHORTEST, _LONGEST = 1.0, 120.0  # s


@dataclass
class _Task:
    """What the steps share."""

    bench: Bench
    present: Present
    design: Design
    pairs: list[tuple[str, str]]
    effects: list[Visible]


@no_warnings()  # some of what is tried comes apart
def excite(
    mapping: Path,
    fit: Path | None = None,
    out: Path | None = None,
    *,
    seconds: float = 10.0,
    seed: int = 0,
    tries: int = 250,
    budget: float = 120.0,
    jobs: int = 0,
    overwrite: bool = False,
    console: Console | None = None,
) -> dict[str, Any]:
    """Propose commands that best tell apart what the present logs leave open.

    Args:
      mapping: the mapping file.
      fit: folder that `close_loop` wrote: its claims are told from their rivals; None asks for the motion in which
        every effect would show at the smallest size.
      out: CSV file of the commands, in the mapping's own units; beside it go the same name with .json (what is
        expected of them) and .html (a picture). None is `excite.csv` beside the mapping.
      seconds: how long.
      seed: the same inputs, seed and number of tries give the same commands, unless the budget ends them.
      tries: sequences that are rolled out, at most.
      budget: s, after which the best so far is taken.
      jobs: threads of the roll-outs; 0 takes every core.
      overwrite: replace such files.
      console: where progress goes; None is silent.

    Returns:
      What the JSON file holds.

    Raises:
      InputError: bad input, or nothing can be proposed, and why.
    """
    if not _SHORTEST <= seconds <= _LONGEST:
        raise InputError(f"--seconds {seconds:g}: want {_SHORTEST:g} to {_LONGEST:g}")
    out = _outputs(out if out is not None else mapping.with_name("excite.csv"), overwrite)
    say = teller(console, time.monotonic())
    dataset, noticed = require(mapping)
    _require_no_log(out, mapping.parent, [entry.path for entry in dataset.mapping.logs])
    warned(console, noticed)
    bench = make_bench(dataset, jobs)
    task, report = _task(bench, fit, seconds, seed, say)
    stage = task.design.stage
    if not stage.open_loop:
        say(
            "under the resting command alone the simulated machine leaves what was recorded: proposing what to add to "
            "the commands of a recorded run, its controller's if it has one"
        )
    last = [0.0]

    def tick(done: int, best: float) -> None:
        if time.monotonic() - last[0] > 2 or done >= tries:
            last[0] = time.monotonic()
            say(f"{done} of at most {tries} motions tried; best so far {best:.3g}")

    rng = np.random.default_rng(seed)
    best, done = task.design.search(rng, tries, budget, tick)
    result = _result(task, best, done, report) | {"seconds": seconds, "seed": seed}
    _verify(task, best, result, rng, say)
    _write(out, bench, stage, best, result)
    for line in result["sentences"]:
        say(line)
    say(f"written: {out}, {out.with_suffix('.json').name}, {out.with_suffix('.html').name}")
    return result


def _outputs(out: Path, overwrite: bool) -> Path:
    if out.suffix.lower() != ".csv":
        raise InputError(f"--out {out}: the commands are a CSV file; name it so, {out.with_suffix('.csv').name}")
    if not out.parent.is_dir():
        raise InputError(f"--out {out}: no such folder as {out.parent}")
    require_writable(out.parent)
    for path in (out, out.with_suffix(".json"), out.with_suffix(".html")):
        if path.exists() and not overwrite:
            raise InputError(f"{path} exists: choose another --out, or say --overwrite to replace it")
    return out


def _require_no_log(out: Path, folder: Path, globs: Sequence[str]) -> None:
    """Refuse a file that the mapping would read as a log from then on."""
    for pattern in globs:
        if _matches((folder.absolute() / pattern).parts, out.absolute().parts):
            raise InputError(
                f"--out {out}: the mapping's logs {pattern!r} would take the commands for a recording; choose a file "
                "that it does not match"
            )


def _matches(pattern: Sequence[str], parts: Sequence[str]) -> bool:
    """Whether a path is what a glob finds, part by part; `**` stands for any folders."""
    if not pattern or not parts:
        return not pattern and not parts
    if pattern[0] == "**":
        return _matches(pattern[1:], parts) or _matches(pattern, parts[1:])
    return fnmatch(parts[0], pattern[0]) and _matches(pattern[1:], parts[1:])


def _task(bench: Bench, folder: Path | None, seconds: float, seed: int, say: Any) -> tuple[_Task, dict[str, Any]]:
    """The questions, and where answers are tried."""
    logs = [log for log in bench.dataset.logs if bench.dataset.splits[log.name] != "verify"] or list(bench.dataset.logs)
    report: dict[str, Any] = {}
    if folder is None:
        say("calibrating psi")
        plant, x = questions.calibrated(bench, logs, seed)
    else:
        report, plant, x = questions.reported(bench, logs, folder)
    stage = Stage(bench, plant, x, logs, seconds)
    say("looking at the present logs")
    present = questions.look(bench, logs, plant, x)
    asks, pairs, skipped = questions.rivalries(bench, logs, report, present) if plant.effects else ([], [], [])
    if skipped:
        say(f"passed over, since it is no single effect: {', '.join(skipped)}")
    effects: list[Visible] = []
    if not asks:
        if folder is not None:
            say("the report leaves no rival explanations: asking for the motion in which most would show")
        taken = {e.id for e in plant.effects}
        pool = [e for e in candidates(bench, logs) if not e.generic and e.id not in taken]
        present = questions.look(bench, logs, plant, x, questions.blocks_for(len(pool)))
        effects = questions.visibilities(pool, present)
        asks = [v.ask for v in effects]
        if not asks:
            raise InputError("no effect of the library can be at work in this model: there is nothing to look for")
        if len(pool) > len(asks):
            say(f"designing for {len(asks)} of {len(pool)} effects, the hardest to see of each family")
    design = Design(Distances(asks, present.lens, present.repeats), stage, rivals=bool(pairs))
    return _Task(bench, present, design, pairs, effects), report


def _result(task: _Task, best: Tried, done: int, report: dict[str, Any]) -> dict[str, Any]:
    """What is expected of the commands, and the sentences that say so."""
    stage = task.design.stage
    kind = "commands" if stage.open_loop else "feed-forward"
    told = (task.design.distances.before, best.answers)
    rows = pair_rows(task.pairs, *told) if task.pairs else size_rows(task.effects, *told)
    sentences = [pair_sentence(r) for r in rows] if task.pairs else [size_sentence(rows)]
    if not stage.open_loop:
        sentences.append(
            "These are no commands by themselves: add them to the controller's own. The machine was followed segment "
            "by segment from recorded states; what the controller does against them is not in the figures."
        )
    key = "pairs" if task.pairs else "sizes"
    return {
        "schema": 1,
        "model": task.bench.dataset.mapping.model_file,
        "kind": kind,
        "motion": f"{best.family.say}, improved",
        key: rows,
        "sentences": sentences,
        "tried": done,
        "starts_from": stage.start.name if stage.open_loop else [log.name for log, _ in stage.recorded],
        "verdict": report.get("verdict"),
        "versions": {"nfc_gym": version("nfc_gym"), "mujoco": mujoco.__version__},
    }


def _verify(task: _Task, best: Tried, result: dict[str, Any], rng: np.random.Generator, say: Any) -> None:
    """Simulate the recording, noise included, and refit each rival to it without straight lines: how far it stays off.

    The expected figures above are linear and count the present logs too; these count the new recording alone.
    """
    if not task.pairs:
        return
    plant, x = task.present.lens.plant, task.present.lens.x
    new = task.design.stage.data(best.w[None]).synthetic(plant, x, rng)
    under = metric(new, new.covariance(plant, x))
    for i, row in enumerate(result["pairs"]):
        other = task.design.distances.asks[i].rival
        say(f"refitting {row['rival']} to a simulated recording")
        rival = fit(new, under, other.plant, other.x, _ROUNDS)
        own = fit(new, under, plant, x, _ROUNDS)
        gap = float(losses(new, under, rival).sum() - losses(new, under, own).sum())
        row["sigma_refitted"] = float(np.sqrt(max(gap, 0.0)))


def _write(out: Path, bench: Bench, stage: Stage, best: Tried, result: dict[str, Any]) -> None:
    """CSV in the mapping's units, JSON and a picture; the CSV last, since it is what is used."""
    mapping = bench.dataset.mapping
    commands = stage.commands(best.w)
    columns = {"time": units.from_si(stage.time, mapping.time.unit)}
    for i, name in enumerate(stage.room.names):
        convert = units.from_si if stage.open_loop else units.change_from_si
        columns[name] = convert(commands[:, i], mapping.controls[name].unit)
    lines = [",".join(columns), *(",".join(f"{v:.9g}" for v in row) for row in np.stack(list(columns.values()), 1))]
    shown = {n: (mapping.controls[n].unit, columns[n]) for n in stage.room.names}
    motion = None
    if stage.open_loop:
        motion = stage.motion(commands[None], [(stage.plant, stage.x)])[0][0]
    write_whole(out.with_suffix(".json"), json.dumps(result, indent=1))
    write_whole(out.with_suffix(".html"), render(result, stage, shown, motion))
    write_whole(out, "\n".join(lines) + "\n")
