"""Does the loop name what a model lacks? Stand-in machines, each with one undeclared effect or none, drawn at run time.

Truth is simulated by separate code at another time step, with psi off by up to 15 % and noisy sensors (`standin/`).
Sizes are drawn so that X / X_null of the true effect spreads over 1.3 to 30. Every error is over the oracle's: the
package's model with the true effect and the true psi, at its own time step. Baselines in the same run: psi alone, and
`mujoco.sysid`.

    python benchmarks/undeclared_effects.py --trials 12 --nulls 12 --jobs 2 --json out.json
"""

import argparse
import json
import math
import os
import secrets
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path

# One thread a trial: numpy's own would only get in the way of the other trials.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from standin.robots import ROBOTS
from standin.trial import Row, Size, trial

QUICK = {
    "jackal": ("coulomb", Size(5, 2.5, ("coulomb", "slope"))),
    "quadcopter": ("wind", Size(5, 2.5, ("wind", "drag_linear"))),
}
GOALS = {"quadcopter": 11 / 12, "jackal": 9 / 12}
BASELINES = ("nominal", "psi only", "sysid")


def main(argv: Sequence[str] | None = None) -> int:
    args = parse(argv)
    seed = secrets.randbits(32) if args.seed is None else args.seed
    print(f"seed {seed} (drawn at run time unless given); {args.jobs} trials at a time")
    plan = planned(args, np.random.default_rng(seed))
    began = time.monotonic()
    rows = list(shown(run(plan, args.jobs, args.threads)))
    results = summary(rows, seed)
    print(table(results))
    print(f"{len(rows)} of {len(plan)} trials, {time.monotonic() - began:.0f} s")
    if args.json:
        args.json.write_text(json.dumps({"rows": results, "trials": [clean(asdict(r)) for r in rows]}, indent=1))
    return 0 if len(rows) == len(plan) else 1


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one tiny trial a robot, with two families in the contest")
    parser.add_argument("--trials", type=int, default=12, help="trials with an effect, a robot (the six take turns)")
    parser.add_argument("--nulls", type=int, default=None, help="trials without, a robot; default as many as --trials")
    parser.add_argument("--robots", nargs="+", choices=list(ROBOTS), default=list(ROBOTS))
    parser.add_argument("--effects", nargs="+", help="only these families")
    parser.add_argument("--seed", type=int, help="repeats a run")
    parser.add_argument("--jobs", type=int, default=1, help="trials at a time, each a process")
    parser.add_argument(
        "--threads", type=int, default=None, help="threads of a trial; default 1, all cores with --jobs 1"
    )
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="rows {name, value, unit, baseline, goal, holds, seeds}"
    )
    return parser.parse_args(argv)


def planned(args: argparse.Namespace, rng: np.random.Generator) -> list[tuple[str, str, int, Size]]:
    """(robot, family, seed, size) of every trial."""
    plan = []
    for robot in args.robots:
        if args.quick:
            family, size = QUICK[robot]
            plan.append((robot, family, int(rng.integers(2**32)), size))
            continue
        kinds = [k for k in ROBOTS[robot].kinds if not args.effects or k in args.effects]
        families = [kinds[i % len(kinds)] for i in range(args.trials)]
        families += ["none"] * (args.trials if args.nulls is None else args.nulls)
        plan += [(robot, f, int(rng.integers(2**32)), Size()) for f in families]
    return plan


def run(plan: Sequence[tuple[str, str, int, Size]], jobs: int, threads: int | None) -> Iterable[Row]:
    """Rows as they finish; a trial that fails is reported and left out."""
    threads = threads if threads is not None else (0 if jobs == 1 else 1)
    if jobs == 1:
        for job in plan:
            yield _one(*job, threads)
        return
    with ProcessPoolExecutor(jobs) as pool:
        for done in as_completed([pool.submit(_one, *job, threads) for job in plan]):
            if done.exception() is None:
                yield done.result()
            else:
                print(f"a trial failed: {done.exception()!r}", file=sys.stderr)


def _one(robot: str, family: str, seed: int, size: Size, threads: int) -> Row:
    with tempfile.TemporaryDirectory(prefix="standin_") as folder:
        return trial(robot, family, seed, Path(folder), size, threads)


def shown(rows: Iterable[Row]) -> Iterable[Row]:
    """Print each row as it comes."""
    names = ("robot", "hidden", "X/X_null", "outcome", "false", "after", *BASELINES, "s", "claims")
    print(" | ".join(names) + "   (errors over the oracle's)")
    for r in rows:
        errors = [f"{r.errors.get(k, math.nan):.2f}" for k in ("after", *BASELINES)]
        claims = "; ".join(r.claims) or r.verdict
        cells = (r.robot, r.hidden, f"{r.ratio:.1f}", r.outcome, r.false_claims, *errors, f"{r.seconds:.0f}", claims)
        print(
            " | ".join(map(str, cells)),
            f"  [{r.family}, seed {r.seed}, oracle X/X_null {r.oracle_x:.2f}] {r.note}",
            flush=True,
        )
        yield r


def summary(rows: Sequence[Row], seed: int) -> list[dict]:
    """Result rows {name, value, unit, baseline, goal, holds, seeds}; `holds` is None where nothing was tried."""
    out = []

    def add(
        name: str, value: float, unit: str, baseline: float | None, goal: str, holds: bool | None, of: Sequence[Row]
    ) -> None:
        row = {"name": name, "value": value, "unit": unit, "baseline": baseline, "goal": goal, "holds": holds}
        out.append(clean(row | {"seeds": [seed, *(r.seed for r in of)]}))

    for robot, share in GOALS.items():
        of = [r for r in rows if r.robot == robot and r.family != "none"]
        if not of:
            continue
        right = [r for r in of if r.outcome == "right"]
        # A model with psi alone names nothing.
        add(
            f"{robot}: named right",
            len(right) / len(of),
            "1",
            0.0,
            f">= {share:.2f}",
            len(right) >= share * len(of) - 1e-9,
            of,
        )
        for low, high in ((1.0, 3.0), (3.0, 10.0), (10.0, math.inf)):
            part = [r for r in of if low <= r.ratio < high]
            if part:
                name = f"{robot}: named right, X/X_null {low:g} to {high:g} ({len(part)} trials)"
                add(name, sum(r.outcome == "right" for r in part) / len(part), "1", 0.0, "", None, part)
        if right:
            worst = max(r.errors["after"] for r in right)
            psi = float(np.median([r.errors["psi only"] for r in right]))
            add(f"{robot}: error after / oracle's, worst right case", worst, "1", psi, "<= 1.15", worst <= 1.15, right)
            found = [r.errors["sysid"] for r in right if "sysid" in r.errors]
            middle = float(np.median([r.errors["after"] for r in right]))
            add(
                f"{robot}: error after / oracle's, median, beside mujoco.sysid",
                middle,
                "1",
                float(np.median(found)) if found else None,
                "",
                None,
                right,
            )
    nulls = [r for r in rows if r.family == "none"]
    if nulls:
        false = sum(r.false_claims > 0 for r in nulls)
        allowed = math.ceil(len(nulls) / 24)  # one in 24; with fewer nulls one cannot be told from chance
        name = f"false claims in {len(nulls)} nulls"
        add(name, false, "trials", None, f"<= {allowed}", false <= allowed, nulls)
    return out


def table(results: Sequence[dict]) -> str:
    """The summary as text."""
    marks = {True: "holds", False: "MISSED", None: ""}
    lines = [f"{'':64s} {'value':>8s} {'baseline':>9s}  goal"]
    for r in results:
        base = "" if r["baseline"] is None else f"{r['baseline']:.3f}"
        lines.append(f"{r['name']:64s} {r['value']:8.3f} {base:>9s}  {r['goal']} {marks[r['holds']]}")
    return "\n".join(lines)


def clean(value: object) -> object:
    """The same with nan and infinity as null, which JSON has no word for."""
    if isinstance(value, dict):
        return {k: clean(v) for k, v in value.items()}
    if isinstance(value, list):
        return [clean(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


if __name__ == "__main__":
    sys.exit(main())
