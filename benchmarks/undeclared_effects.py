"""Does the loop name what a model lacks? Stand-in machines whose undeclared effects are drawn at run time.

Four robots (quadcopter, wheeled, two legged). Truth is simulated by separate code at another time step, with psi off by
up to 15 % and noisy sensors (`standin/`). Effects are sized so that X / X_null of each alone spreads over 1.3 to 30,
log-uniform. Trials: single effects, pairs of unlike effects, effects that the library has no law for, and none at all.
Every error is over the oracle's: the package's model with the true effect and the true psi, at its own time step.
Baselines in the same run: psi alone, `mujoco.sysid`, sparse regression by `pysindy`, and a learned residual network.

    python benchmarks/undeclared_effects.py --trials 5 --pairs 10 --outside 5 --nulls 31 --jobs 32 --out results/
"""

import argparse
import json
import math
import os
import secrets
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

# One thread a trial: numpy's own would only get in the way of the other trials.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from options import count, ended, json_file, made, number, read_json, write_json
from standin import plan
from standin.robots import ROBOTS
from standin.row import Row, Task, from_json, to_json
from standin.summary import summarise, table

STAGES = ("nominal", "psi only", "sysid", "network")


def main(argv: Sequence[str] | None = None) -> int:
    args = parse(argv)
    if args.begin:
        taken_over(args)
    seed = master_seed(args)
    tasks, kept = planned(args, seed), plan.Kept(args.out)
    planned_count = len(tasks)
    if args.kept:
        tasks = [t for t in tasks if kept.get(t) is not None]
    if args.most is not None:
        left = [t for t in tasks if kept.get(t) is None][args.most :]
        tasks = [t for t in tasks if t not in left]
    print(f"seed {seed} (drawn at run time unless given); {len(tasks)} trials, {args.jobs} at a time", flush=True)
    threads = args.threads if args.threads is not None else (0 if args.jobs == 1 and not args.quick else 1)
    began = time.monotonic()
    rows: list[Row] = []
    try:
        rows += shown(plan.run(tasks, args.jobs, threads, kept))
    except KeyboardInterrupt:
        print("stopped" + (f"; the same command with --out {args.out} goes on from here" if args.out else ""))
    results = summarise(rows, seed)
    print(table(results))
    print(f"{len(rows)} of {planned_count} trials, {time.monotonic() - began:.0f} s; seed {seed}")
    for path in (args.json, args.out / "results.json" if args.out else None):
        if path:
            write_json(path, {**made(args), "seed": seed, "rows": results, "trials": [to_json(r) for r in rows]})
    return 0 if args.kept or len(rows) == planned_count else 1


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    families = sorted({f for r in ROBOTS.values() for f in r.named})
    wider = sorted({f for r in ROBOTS.values() for f in r.wider})
    add = parser.add_argument
    add("--quick", action="store_true", help="one tiny trial a robot, with one or two families in the contest")
    add("--robots", nargs="+", type=str.lower, choices=list(ROBOTS), help="default all; with --quick the Quadcopter")
    add("--trials", "--seeds", type=count(0), default=1, help="machines of each single effect, a robot (default 1)")
    some = parser.add_mutually_exclusive_group().add_argument
    some("--effects", nargs="+", choices=families, metavar="FAMILY", help="only these single effects, usual or wider")
    some("--wider", action="store_true", help=f"the single effects that are not usual: {', '.join(wider)}")
    add("--pairs", type=count(0), default=0, help="machines with two effects, a robot")
    add("--outside", type=count(0), default=0, help="machines of each effect outside the library, a robot")
    add("--nulls", type=count(0), default=0, help="machines without any effect, a robot")
    add(
        "--baselines", type=number(0, 1), default=0.2, metavar="SHARE", help="of single effects with the slow baselines"
    )
    add("--seed", type=count(0), help="repeats a run; default drawn, or the one that --out was begun with")
    add("--jobs", type=count(1), default=1, help="trials at a time, each a process")
    add("--threads", type=count(0), help="of a trial; default 1, all cores with --jobs 1 and without --quick")
    add("--out", type=Path, metavar="DIR", help="keeps trials, half-done ones too, and reports: a killed run goes on")
    add("--begin", type=Path, metavar="FILE", help="take over seed and trials that an earlier run's --json wrote")
    add("--most", type=count(0), metavar="N", help="of trials that are not finished only the first N of the plan")
    add("--kept", action="store_true", help="no new trials: figures of those that --out holds")
    add("--json", type=json_file, metavar="FILE", help="figures {name, value, unit, baseline, goal, holds, seeds, ...}")
    return parser.parse_args(argv)


def master_seed(args: argparse.Namespace) -> int:
    """The given seed, else the one that the folder was begun with, else a new one; the folder keeps it."""
    path = args.out / "seed.json" if args.out else None
    kept = json.loads(path.read_text())["seed"] if path and path.exists() else None
    if kept is not None and args.seed not in (None, kept):
        sys.exit(f"{args.out} was begun with seed {kept}: leave --seed out, or choose another --out")
    seed = kept if kept is not None else args.seed if args.seed is not None else secrets.randbits(32)
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"seed": seed}))
    return seed


def taken_over(args: argparse.Namespace) -> None:
    """Put the seed and the trials of an earlier run's figures into `--out`, to go on from there."""
    if not args.out:
        sys.exit("--begin FILE wants --out DIR: where its trials are to be kept")
    content = read_json(args.begin, "rows", "trials")
    args.seed = content["rows"][0]["seeds"][0]
    master_seed(args)
    kept = plan.Kept(args.out)
    for row in map(from_json, content["trials"]):
        task = Task(row.robot, row.group, tuple(row.families), row.seed, baselines=bool({"sysid"} & set(row.errors)))
        if kept.get(task) is None:
            kept.put(task, row)


def planned(args: argparse.Namespace, seed: int) -> list[Task]:
    """Every trial; robots and kinds of trial are woven, so that a run that is stopped early has its share of each."""
    if args.quick:
        return plan.quick(args.robots or ("quadcopter",), seed)
    lanes = []
    for robot in args.robots or ROBOTS:
        singles = list(plan.singles(robot, args.effects or (), args.trials, seed, args.wider))
        pairs = list(plan.pairs(robot, args.pairs, seed))
        lanes.append(plan.woven([singles, pairs, *plan.others(robot, args.outside, args.nulls, seed)]))
    return plan.with_baselines(plan.woven(lanes), args.baselines)


def shown(rows: Iterable[tuple[Row, str]]) -> Iterable[Row]:
    """Print each row as it comes."""
    print(
        " | ".join(("robot", "hidden", "X/X_null", "outcome", "after", *STAGES, "s", "claims"))
        + "  (errors over the oracle's)"
    )
    for r, progress in rows:
        errors = [f"{r.errors.get(k, math.nan):.2f}" for k in ("after", *STAGES)]
        claims = "; ".join(r.claims) or r.verdict
        cells = (r.robot, r.hidden, f"{r.ratio:.1f}", r.outcome, *errors, f"{r.seconds:.0f}", claims)
        more = f"oracle X/X_null {r.oracle_x:.2f}" if math.isfinite(r.oracle_x) else r.coordinate
        sindy = f"; pysindy: {r.sindy['named'] or 'nothing'}" if r.sindy else ""
        told = "" if r.foretold is None else "; foretold" if r.foretold else "; not foretold"
        print(
            " | ".join(cells),
            f"  [{'+'.join(r.families) or 'none'}, seed {r.seed}, {more}{told}{sindy}]{r.note}  {progress}",
            flush=True,
        )
        yield r


if __name__ == "__main__":
    sys.exit(ended(main))
