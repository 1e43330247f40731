"""What a structure head is worth to the measured loop: area under the curve, time, and whether verdicts stay the same.

For each robot: windows with effects are simulated and a head is trained on them (`nfc-gym simulate`, `nfc-gym train
--structure`), judged on windows of its own, and handed to the loop on stand-in machines whose effects are drawn at run
time (`standin/`). Each trial runs twice on the same logs, without the head (the baseline) and with it, in an order that
alternates; times are processor seconds of one thread, as other work may share the machine.

    python benchmarks/structure.py --robots quadcopter jackal --trials 6 --out results/

The same command goes on where it was stopped.
"""

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from options import count, ended, json_file, made, number, write_json
from posteriors.keep import begun, belongs
from standin import plan
from standin.heads import ENVIRONMENTS, STRONG, Course, judged, taught, threads
from standin.robots import ROBOTS
from standin.row import Row, Size, Task, clean
from standin.score import score
from standin.trial import prepared

from nfc_gym.core.files import write_whole
from nfc_gym.measured.loop import close_loop
from nfc_gym.simulate.witness import Witness

AREA, TWICE = 0.95, 2.0  # goals: of the area for strong effects, of the time without over the time with


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; 1 where there is no figure."""
    args = parse(argv)
    threads(1)
    folder = args.out or Path(tempfile.mkdtemp(prefix="structure_"))
    folder.mkdir(parents=True, exist_ok=True)
    try:
        rows = run(args, folder)
    finally:
        if args.out is None:
            shutil.rmtree(folder, ignore_errors=True)
    return 0 if rows else 1


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """The command line's arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--quick", action="store_true", help="a toy's head, one tiny trial of the Quadcopter")
    add(
        "--robots",
        nargs="+",
        type=str.lower,
        choices=list(ENVIRONMENTS),
        default=["quadcopter"],
        help="default quadcopter",
    )
    add("--trials", type=count(0), default=6, help="machines a robot, each with one effect (default 6)")
    add("--nulls", type=count(0), default=0, help="machines a robot without any")
    add("--windows", type=count(1), default=Course().windows, help="that a head is trained on")
    add("--epochs", type=count(1), default=Course().epochs, help="of its training, at most")
    add("--no-mirror", action="store_true", help="show no window in the robot's mirrors")
    add("--jobs", type=count(0), default=1, help="processes that simulate its windows")
    add("--device", default="cpu", help="that it is trained on (default cpu)")
    add("--seed", type=count(0), help="repeats a run; default drawn, or the one that --out was begun with")
    add("--stop", type=number(0), default=float("inf"), metavar="SECONDS", help="begin no trial after so long")
    add("--out", type=Path, metavar="DIR", help="keeps windows, heads and finished trials, and results.json")
    add("--json", type=json_file, metavar="FILE",
        help="write rows {name, value, unit, baseline, goal, holds, seeds} here, and how they were made")  # fmt: skip
    return parser.parse_args(argv)


def run(args: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """All that is asked for; finished parts are read back."""
    began = time.monotonic()
    seed = begun(folder, args.seed)
    print(f"seed {seed} (drawn at run time unless given)", flush=True)
    course = Course(96, 64, 1, small=True) if args.quick else Course(args.windows, epochs=args.epochs)
    course = replace(course, mirror=not args.no_mirror)
    settings = {name: getattr(course, name) for name in ("windows", "epochs", "small", "mirror")}
    belongs(folder, {"seed": seed, **settings})
    rows: list[dict[str, Any]] = []
    for robot in args.robots:
        head = taught(robot, course, folder, seed, args.jobs, args.device)
        how = (robot, head, course, folder, seed, args.jobs)
        told = _kept(folder / f"{robot}_judged.json", lambda how=how: judged(*how))
        rows += told_rows(robot, told)
        trials = []
        for i, task in enumerate(tasks(robot, args, seed)):
            if time.monotonic() - began > args.stop:
                break
            trials.append(_kept(folder / f"{task.name}.json", lambda t=task, h=head, i=i: both(t, h, bool(i % 2))))
            print(said(trials[-1]), flush=True)
        rows += loop_rows(robot, trials)
    rows = [r | {"seeds": [seed]} for r in rows]
    print(table(rows))
    for path in (folder / "results.json", args.json):
        if path:
            write_json(path, {**made(args), "seed": seed, "rows": rows})
    return rows


def tasks(robot: str, args: argparse.Namespace, seed: int) -> list[Task]:
    """Single effects, families in an order drawn from the seed; then machines that lack nothing."""
    if args.quick:
        families, size = ("wind",), Size(3, 0.5, ("wind",), 1)
        return [Task(robot, "single", families, plan.seed_of(seed, robot, "quick"), size)]
    families = np.random.default_rng(plan.seed_of(seed, robot, "order")).permutation(sorted(ROBOTS[robot].kinds))
    chosen = [str(families[i % len(families)]) for i in range(args.trials)]
    singles = [Task(robot, "single", (f,), plan.seed_of(seed, robot, f, i)) for i, f in enumerate(chosen)]
    return singles + [Task(robot, "null", (), plan.seed_of(seed, robot, "null", i)) for i in range(args.nulls)]


def both(task: Task, head: Path, head_first: bool) -> dict[str, Any]:
    """One trial without and with the head, on the same logs."""
    folder = Path(tempfile.mkdtemp(prefix="standin_"))
    try:
        case = prepared(task, folder)
        out: dict[str, Any] = {"hidden": case.hidden.text, "robot": task.robot, "ratio": case.ratio}
        out["families"], out["likely"] = list(task.families), []
        for name in ("with", "without") if head_first else ("without", "with"):
            witness = (Witness(head), head) if name == "with" else None
            began = time.process_time()
            report = close_loop(case.mapping, folder / name, seed=task.seed % 2**31, jobs=1, witness=witness)
            row = Row(task.robot, task.group, list(task.families), task.seed)
            out[name] = {"cpu": time.process_time() - began, "wall": report["seconds"]}
            score(row, report, case.hidden, case.outside)
            chi2 = report["chi2"]["extended"] / report["chi2"]["null"]
            out[name] |= {"verdict": row.verdict, "claims": row.claims, "outcome": row.outcome, "chi2": chi2}
            if report["structure"]:
                told = report["structure"]
                out["likely"], out["asking"] = told["looked_at_first"], told["seconds"]
                out["told"] = sum(told["families"].get(f, 0.0) for f in task.families or ("none",))
        return clean(out)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def told_rows(robot: str, told: dict[str, Any]) -> list[dict[str, Any]]:
    """What the head tells of single windows."""
    strong = f"{told['strong']} windows with X / X_null >= {STRONG:g}"
    return [
        row(robot, f"area under the curve, {strong}", told["area"], "1", told["area_of_x"], AREA),
        row(robot, "the same of all effects", told["area_all"], "1"),
        row(robot, f"area one family against the rest, mean of {told['families']}, strong", told["one_vs_rest"], "1"),
        row(robot, "the right family among its first three, strong", told["among_three"], "1"),
    ]


def loop_rows(robot: str, trials: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """What it is worth to the loop."""
    if not trials:
        return []
    count = len(trials)
    times = {k: np.array([t[k]["cpu"] for t in trials]) for k in ("without", "with")}
    ratio = times["without"] / times["with"]
    same = {
        "verdict": sum(t["with"]["verdict"] == t["without"]["verdict"] for t in trials),
        "claims": sum(first(t["with"]) == first(t["without"]) for t in trials),
    }
    right = {k: sum(t[k]["outcome"] == "right" for t in trials) for k in ("with", "without")}
    return [
        row(robot, f"time without over time with, median of {count}", float(np.median(ratio)), "1", 1.0, TWICE),
        row(robot, "least and most of these, least", float(ratio.min()), "1"),
        row(robot, "most", float(ratio.max()), "1"),
        row(robot, "time with, median", float(np.median(times["with"])), "s", float(np.median(times["without"]))),
        row(robot, f"same verdict, of {count}", same["verdict"], "1", goal=count),
        row(robot, f"same claims, of {count}", same["claims"], "1", goal=count),
        row(robot, f"right, of {count}", right["with"], "1", right["without"]),
        row(robot, "hidden family looked at first by the head alone", sum(hit(t) for t in trials), "1"),
    ]


def first(told: dict[str, Any]) -> list[str]:
    """Ids that are claimed, without their equivalents."""
    return sorted(c.split(" = ")[0] for c in told["claims"])


def hit(trial: dict[str, Any]) -> bool:
    """Whether the head held the hidden family possible."""
    return any(f in trial["likely"] for f in trial["families"])


def row(
    robot: str, name: str, value: float | None, unit: str, baseline: float | None = None, goal: float | None = None
) -> dict[str, Any]:
    """A line of the table, but for the seeds: as `timing.Row`. A goal is reached by that much or more.

    The value is None where too few windows tell it.
    """
    told = None if goal is None else f">= {goal:g}"
    rest = {
        "baseline": baseline,
        "goal": told,
        "holds": None if goal is None else value is not None and bool(value >= goal),
    }
    return {"name": f"{robot}: {name}", "value": None if value is None else float(value), "unit": unit} | rest


def said(t: dict[str, Any]) -> str:
    """A trial in a line."""
    parts = [f"{t['robot']}: {t['hidden']} (X / X_null {t['ratio'] or float('nan'):.1f})"]
    loops = [(k, t[k]) for k in ("without", "with")]
    parts += [f"{k} {r['cpu']:.0f} s, {r['verdict']}, {'; '.join(r['claims']) or '-'}" for k, r in loops]
    return " | ".join([*parts, f"head: {', '.join(t['likely'])}"])


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as text."""
    number = lambda v: "-" if v is None else f"{v:.3g}"  # noqa: E731
    lines = ["what | value | baseline | goal | holds"]
    for r in rows:
        holds = {None: "-", True: "yes", False: "no"}[r["holds"]]
        value = f"{number(r['value'])} {r['unit']}" if r["unit"] != "1" else number(r["value"])
        lines.append(f"{r['name']} | {value} | {number(r['baseline'])} | {r['goal'] or '-'} | {holds}")
    return "\n".join(lines)


def _kept(path: Path, make: Any) -> Any:
    """What a file holds, or what is made now and kept in it."""
    if not path.exists():
        write_whole(path, json.dumps(clean(make())))
    return json.loads(path.read_text())


if __name__ == "__main__":
    sys.exit(ended(main))
