"""Worlds that hide their truth: what a policy loses in each, and which of them count.

    python benchmarks/hidden_worlds.py --policy falco --places JackalFlat JackalRough --task figure8 --episodes 100
    python benchmarks/hidden_worlds.py --policy ant.safetensors --places AntFlat --find 3 --draws 20
    python benchmarks/hidden_worlds.py --quick

A world counts where the policy loses at least 30 % of the return that it earns at home beyond a random policy's.
Sizes are drawn from `--seed`, by default drawn itself and printed. `--find K` draws worlds of a scenario one after
another until K count, and prints those that do not as well; what counts is measured again with other episodes and must
count then too, since of many worlds some lose much by chance. A draw that the engine refuses is left out, and said.
`--out DIR` keeps every world's row and goes on there.
The paper's scenarios of the Jackal's axle are what is measured where none is named.
"""

import argparse
import os
import secrets
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from options import count, ended, json_file, made, write_json
from posteriors.keep import Kept, begun
from worlds.counting import DROP, Drop, measure
from worlds.scenarios import TABLE_III
from worlds.world import ENGINES, World

_OTHERS = 1_000_000  # what leads to the seed of other episodes


def main(argv: Sequence[str] | None = None) -> int:
    args = parse(argv)
    kept = Kept(args.out, {"seed": args.seed, "policy": args.policy, "task": args.task, "episodes": args.episodes}) \
        if args.out else None  # fmt: skip
    print(f"seed {args.seed}, policy {args.policy}, {args.episodes} episodes a world", flush=True)
    print("world | return at home | there | random | drop | counts | success | ended early | ratio | hidden")
    rows = []
    for place in args.places:
        for scenario in args.scenarios or default(place):
            rows += [shown(r) for r in worlds(args, kept, place, scenario)]
    print(f"{sum(r['counts'] for r in rows)} of {len(rows)} worlds count")
    if args.json:
        write_json(args.json, {**made(args), "rows": [figure(r, args) for r in rows], "worlds": rows})
    return 0


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add(
        "--policy", default="falco", help="falco, random, a policy's file, or an id whose policy comes with the package"
    )
    add("--places", nargs="+", default=["JackalFlat", "JackalRough"], metavar="PLACE", help="such as AntRough")
    add("--scenarios", nargs="+", metavar="PARTS", help="such as axle+snow; default the paper's, or psi+effect")
    add("--engine", choices=ENGINES, default="mujoco", help="bullet: PyBullet, for Jackal, Quadcopter, Quadruped")
    add("--task", choices=("goal", "figure8"), help="of Jackal and Quadcopter; default goal")
    add("--episodes", type=count(1), default=100)
    add("--worlds", type=count(1), default=1, help="drawn of each scenario")
    add("--threads", type=count(0), default=1, help="of the physics; 0 is all cores")
    add("--find", type=count(1), metavar="K", help="go on until K of a scenario count")
    add("--draws", type=count(1), default=20, help="worlds drawn at most by --find")
    add("--seed", type=count(0), help="of what is hidden and of the episodes; default drawn")
    add("--out", type=Path, metavar="DIR", help="keeps finished worlds")
    add("--json", type=json_file, metavar="FILE")
    add("--quick", action="store_true", help="two worlds, a few episodes: a toy")
    args = parser.parse_args(argv)
    if args.quick:
        args.scenarios, args.episodes = args.scenarios or ["axle"], 4
    for place in args.places:  # a wrong name ends the run before its first world
        for scenario in args.scenarios or default(place):
            World(place, scenario, 0, engine=args.engine)
    if args.out:
        args.seed = begun(args.out, args.seed)
    elif args.seed is None:
        args.seed = secrets.randbits(31)
    return args


def default(place: str) -> tuple[str, ...]:
    if not place.startswith("Jackal"):
        return ("psi+effect",)
    return TABLE_III["Rough" if place.endswith("Rough") else "Flat"]


def worlds(args: argparse.Namespace, kept: Kept | None, place: str, scenario: str) -> Iterator[dict[str, Any]]:
    """Rows of the worlds of one scenario, as they are measured."""
    found = 0
    for k in range(args.draws if args.find else args.worlds):
        world = World(place, scenario, args.seed + k, engine=args.engine)
        if args.find and world.refused:
            print(f"{world.name} is left out: {world.refused}", flush=True)
            continue

        def row(world: World = world) -> dict[str, Any]:
            began = time.monotonic()
            settings = {"nthread": args.threads} | ({"task": args.task} if args.task else {})
            found = measure(args.policy, world, args.episodes, args.seed, **settings)
            told = plain(found, time.monotonic() - began)
            if not (args.find and found.counts):
                return told
            again = measure(args.policy, world, args.episodes, args.seed + _OTHERS, **settings)
            return told | {"again": again.drop, "counts": again.counts, "seconds": time.monotonic() - began}

        result = kept.once(world.name, row) if kept else row()
        if kept and args.find and result["counts"] and "again" not in result:  # of a run without --find
            kept.keep(world.name, result := row())
        yield result
        found += result["counts"]
        if args.find and found >= args.find:
            return


def plain(drop: Drop, seconds: float) -> dict[str, Any]:
    """A row that JSON holds."""
    e = drop.episodes
    ratios = [r for r in e.ratio if r == r]
    return {
        **{k: getattr(drop.world, k) for k in ("place", "scenario", "seed", "engine")},
        "world": drop.world.name, "hidden": drop.world.truth.text, "home": drop.nominal, "there": drop.there,
        "random": drop.random, "drop": drop.drop, "counts": bool(drop.counts), "success": float(np.mean(e.success)),
        "early": float(np.mean(e.ended)), "ratio": float(np.mean(ratios)) if ratios else None,
        "orientation_jerk": float(np.nanmean(e.orientation_jerk)),
        "position_jerk": float(np.nanmean(e.position_jerk)), "seconds": seconds,
    }  # fmt: skip


def shown(row: dict[str, Any]) -> dict[str, Any]:
    """Print it."""
    home, there, random = ("{:.0f} [{:.0f}, {:.0f}]".format(*row[k]) for k in ("home", "there", "random"))
    ratio = "-" if row["ratio"] is None else f"{row['ratio']:.2f}"
    drop = f"{row['drop']:.0%}" + (f", then {row['again']:.0%}" if "again" in row else "")
    print(f"{row['world']} | {home} | {there} | {random} | {drop} | {'yes' if row['counts'] else 'no'} | "
          f"{row['success']:.2f} | {row['early']:.2f} | {ratio} | {row['hidden']}", flush=True)  # fmt: skip
    return row


def figure(row: dict[str, Any], args: argparse.Namespace) -> dict[str, Any]:
    """A figure with what it is compared to."""
    return {"name": f"drop of {args.policy} in {row['world']}", "value": row["drop"], "unit": "1", "baseline": None,
            "goal": f">= {DROP:g}", "holds": row["counts"], "seeds": [args.seed]}  # fmt: skip


if __name__ == "__main__":
    sys.exit(ended(main))
