"""The paper's Tables II and III: what policies are worth in worlds that hide their truth, after adapting and before.

    python benchmarks/policies.py --tables II III --policies DIR --posteriors DIR --world-models DIR --out results/
    python benchmarks/policies.py --tables III --methods random falco --out results/
    python benchmarks/policies.py --quick

Table II: return in a hidden world of each environment, between a random policy (0) and an oracle that was trained there
(1), the paper's min-max normalisation beside. Table III: the Jackal's broken axle on a figure of eight, in the paper's
scenarios. With `--counting` Table II takes the worlds that `hidden_worlds.py --find K --json FILE` has found to count.
Every cell (table, world, method, seed) is kept in --out, so the same command goes on where it was stopped; `--stop
SECONDS` begins no new cell after that time, and `--kept` begins none: tables of what there is. `--beside DIR` takes the
random policy, the unadapted policy and the oracle of an earlier run in the same worlds, of all its seeds, and runs
none. `--also DIR ...` shows cells of other runs in the same worlds in the same tables, also where other numbers of
episodes judged them (the tables say how many):

    python benchmarks/policies.py --tables III --seed 1 --seeds 0 --steps 500000 --envs 32 --executed 5 --kept \\
        --out benchmarks/results/policies_eight --also benchmarks/results/policies_tdmpc2_eight

What is hidden is drawn from `--seed`, itself drawn once and kept.
Pretrained policies are those that `pretrain.py --out DIR` made, else the package's; posteriors (also .npz) and
detectors are `<place>.safetensors` in their folders; so are TD-MPC2's world models, which `tdmpc2_pretrain.py` makes.
The control rate is that of one robot's decisions on this machine.
--quick adapts the package's policy of the Jackal for a moment, tries most methods in Table II alone, TD-MPC2 in
neither, and ends within two minutes; its figures mean nothing.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from options import count, ended, json_file, made, number, read_json, write_json
from posteriors.keep import Kept, begun
from worlds import paper, tables
from worlds.learning import Budget
from worlds.machines import ROBOTS, nominal_space
from worlds.methods import METHODS, Job, run
from worlds.scenarios import TABLE_III
from worlds.world import ENGINES, World

from nfc_gym.adaptation.threads import limit_threads
from nfc_gym.core.errors import InputError

REFERENCES = ("random", "unadapted", "oracle")  # what returns are measured by
ADAPTED = ("nfc", "no_nfc", "tdmpc2")  # to what was executed: they take longest, and go the same way in both tables
PLACES = tuple(f"{robot}{ground}" for robot in paper.ROBOTS for ground in paper.GROUNDS)


def main(argv: Sequence[str] | None = None) -> int:
    args = parse(argv)
    began = time.monotonic()
    limit_threads(args.threads)
    with tempfile.TemporaryDirectory() as folder:
        out = args.out or Path(folder)
        args.seed = begun(out, args.seed)
        if args.quick:
            toy(args, out)
        kept = Kept(out, {"seed": args.seed, "episodes": args.episodes, "steps": args.steps, "envs": args.envs,
                          "executed": args.executed, "task": args.task, "engine": args.engine})  # fmt: skip
        cells = filled(args, kept, out, began)
        for folder in args.also:
            joined(args, folder, cells)
        if args.beside:
            references(args, cells)
        rng = np.random.default_rng(0)
        parts = [table(cells, args.methods, rng) for table in (tables.table_two, tables.table_three)]
        text = "\n".join(t for t, _ in parts if t) + f"\n{paper.CAVEAT}\n"
        (out / "tables.md").write_text(text)
        print(text)
        if args.json:
            rows = [row for _, rows in parts for row in rows]
            write_json(args.json, {**made(args), "rows": rows, "seed": args.seed})
    return 0


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--tables", nargs="+", choices=("II", "III"), default=["II", "III"])
    add("--places", nargs="+", choices=PLACES, default=list(PLACES), metavar="PLACE", help="of Table II")
    add("--grounds", nargs="+", choices=paper.GROUNDS, default=list(paper.GROUNDS), help="of Table III")
    add("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    add("--seeds", nargs="+", type=count(0), default=[0, 1, 2], help="of learning")
    add("--worlds", type=count(1), default=1, help="hidden worlds a scenario")
    add("--counting", type=Path, metavar="FILE", help="of `hidden_worlds.py --json`: Table II takes what counts there")
    add("--scenario", default="psi+effect", help="of Table II")
    add("--scenarios", nargs="+", metavar="PARTS", help="of Table III; default the paper's")
    add("--engine", choices=ENGINES, default="mujoco", help="of the true worlds; bullet: PyBullet")
    add("--task", choices=("goal", "figure8"), default="figure8", help="of Table III")
    add("--episodes", type=count(1), default=100, help="that judge a policy")
    add("--policies", type=Path, metavar="DIR")
    add("--posteriors", type=Path, metavar="DIR")
    add("--detectors", type=Path, metavar="DIR")
    add("--world-models", type=Path, metavar="DIR", help="of TD-MPC2")
    add("--envs", type=count(1), default=1024)
    add("--steps", type=count(1), default=20_000_000, help="control steps of learning in simulation")
    add("--budget", type=number(0), default=1800.0, metavar="SECONDS", help="of learning in simulation")
    add("--executed", type=count(0), default=10, help="episodes in the true world that adapting may use")
    add(
        "--ratio", type=number(0), default=1.0, help="updates of TD-MPC2 a control step in the true world; published: 1"
    )
    add("--points", type=count(0), default=10, help="of TD-MPC2's curve in the true world beyond its first")
    add("--judged", type=count(1), default=32, help="episodes at each point of a curve")
    add("--compile", action="store_true", help="torch's compiler fuses what TD-MPC2 computes; it takes a minute or two")
    add("--threads", type=count(0), default=0, help="of the physics; 0 is all")
    add("--device", default="cpu")
    add("--seed", type=count(0), help="of what is hidden; default drawn once, and kept in --out")
    add("--beside", type=Path, metavar="DIR", help="--out of an earlier run, perhaps with another budget")
    add("--also", nargs="+", type=Path, default=[], metavar="DIR", help="--out of other runs whose cells are shown too")
    add("--stop", type=number(0), metavar="SECONDS")
    add("--kept", action="store_true", help="make the tables of the cells in --out")
    add("--out", type=Path, metavar="DIR")
    add("--json", type=json_file, metavar="FILE")
    add("--quick", action="store_true")
    args = parser.parse_args(argv)
    if args.kept and not (args.out and args.out.is_dir()):
        parser.error(f"--kept makes tables of the cells in --out: want a folder that is there, got {args.out}")
    return args


def toy(args: argparse.Namespace, out: Path) -> None:
    """Settings of a minute, and a posterior that knows no more than the prior."""
    args.places, args.grounds, args.seeds = ["JackalFlat"], ["Flat"], [0]
    args.methods = [m for m in args.methods if m in ("random", "unadapted", "nfc", "oracle", "falco")]
    args.episodes, args.envs, args.steps, args.budget, args.executed, args.scenarios = 2, 16, 2_000, 1.0, 1, ["axle"]
    args.threads, args.scenario = 1, "psi"  # some effects push in every step, in Python
    args.posteriors = out / "toys"
    args.posteriors.mkdir(exist_ok=True)
    space = nominal_space(ROBOTS["jackal"])
    psi = np.random.default_rng(0).uniform(space.low, space.high, (64, len(space)))
    np.savez(args.posteriors / "JackalFlat.npz", psi=psi)


def worlds_of(args: argparse.Namespace) -> list[World]:
    """Of Table II: the first that were found to count, or drawn ones."""
    if not args.counting:
        return [World(p, args.scenario, args.seed + k, engine=args.engine) for p in args.places
                for k in range(args.worlds)]  # fmt: skip
    rows = [r for r in read_json(args.counting, "worlds")["worlds"] if r["counts"]]
    worlds = []
    for place in args.places:
        own = [World(place, r["scenario"], r["seed"], engine=r["engine"]) for r in rows if r["place"] == place]
        if not own:
            print(f"{place}: no world of {args.counting} counts: left out", flush=True)
        worlds += own[: args.worlds]
    return worlds


def asked(args: argparse.Namespace) -> Iterator[tuple[str, World, str | None, int]]:
    """Table, world, task and seed of every cell."""
    for seed in args.seeds:
        if "II" in args.tables:
            for world in worlds_of(args):
                yield "II", world, None, seed
        if "III" in args.tables:
            for ground in args.grounds:
                for scenario in args.scenarios or TABLE_III[ground]:
                    for k in range(args.worlds):
                        yield (
                            "III",
                            World(f"Jackal{ground}", scenario, args.seed + k, engine=args.engine),
                            args.task,
                            seed,
                        )


def filled(args: argparse.Namespace, kept: Kept, out: Path, began: float) -> tables.Cells:
    """All cells that there are or are asked for."""
    cells = tables.Cells()
    points, judged = (2, 2) if args.quick else (args.points, args.judged)
    home, watched = (40, 100) if args.quick else (Budget.home, Budget.watched)
    budget = Budget(args.envs, args.steps, args.budget, args.executed, judged, points, args.threads, args.device,
                    args.ratio, home, watched, args.compile)  # fmt: skip
    for table, world, task, seed in asked(args):
        left_out = REFERENCES if args.beside else (*ADAPTED, "oracle") if args.quick and table == "III" else ()
        for method in [m for m in args.methods if m not in left_out]:
            if args.stop and time.monotonic() - began > args.stop:
                print("time is up: the same command goes on")
                return cells
            name = f"{table}_{world.name}_{method}_{seed}"
            if args.kept and not (kept.cells / f"{name}.json").is_file():
                continue
            *given, model = files(args, world.place)
            job = Job(world, seed, *given, budget, task, out / "states" / name, model)
            start = time.monotonic()
            of = {"ratio": args.ratio} if method == "tdmpc2" else {}
            cell = kept.once(name, lambda m=method, j=job: run(m, j, args.episodes), **of)
            cells.add((table, world.place, world.scenario, world.seed, seed), method, cell)
            print(f"{name}: {told(cell)}, {time.monotonic() - start:.0f} s", flush=True)
    return cells


def references(args: argparse.Namespace, cells: tables.Cells) -> None:
    """What a table is measured by, of all seeds of an earlier run in the same worlds."""
    for table, world in dict.fromkeys((table, world) for table, world, *_ in asked(args)):
        for method in REFERENCES:
            for file in sorted((args.beside / "cells").glob(f"{table}_{world.name}_{method}_*.json")):
                key = (table, world.place, world.scenario, world.seed, int(file.stem.rpartition("_")[2]))
                cells.add(key, method, json.loads(file.read_text()))


def joined(args: argparse.Namespace, folder: Path, cells: tables.Cells) -> None:
    """Cells of another run, of the methods, worlds and seeds that are asked for and not there yet.

    Raises:
      InputError: no such folder, or something else was hidden there.
    """
    if not (folder / "cells").is_dir():
        raise InputError(f"--also {folder}: no cells there; want the --out of another run")
    for table, world, _, seed in asked(args):
        key = (table, world.place, world.scenario, world.seed, seed)
        there = cells.found.get(key, {})
        for method in [m for m in args.methods if m not in there]:
            file = folder / "cells" / f"{table}_{world.name}_{method}_{seed}.json"
            if file.is_file():
                cell = json.loads(file.read_text())
                hidden = {c["hidden"] for c in (cell, *there.values()) if "hidden" in c}
                if len(hidden) > 1:
                    raise InputError(f"{file} is of another world than other cells of its name, as what is "
                                     f"hidden shows ({'; '.join(sorted(hidden))}): leave its folder out")  # fmt: skip
                cells.add(key, method, cell)


def files(args: argparse.Namespace, place: str) -> tuple[str, str | None, str | None, str | None]:
    """Policy, posterior, detector and world model of a place: files, or for the policy an id."""
    posterior = file_of(args.posteriors, place, (".npz", ".safetensors"))
    return (
        file_of(args.policies, place, ("-v0.safetensors", ".safetensors")) or place,
        posterior,
        file_of(args.detectors, place),
        file_of(args.world_models, place),
    )


def told(cell: dict) -> str:
    """A cell in a few words."""
    if "missing" in cell:
        return f"missing: {cell['missing']}"
    e = cell["episodes"]
    return f"return {np.mean(e['returns']):.0f}, success {np.mean(e['success']):.2f}"


def file_of(folder: Path | None, place: str, suffixes: Sequence[str] = (".safetensors",)) -> str | None:
    """A place's file in a folder, where both are there."""
    found = [] if folder is None else [folder / f"{place}{s}" for s in suffixes if (folder / f"{place}{s}").is_file()]
    return str(found[0]) if found else None


if __name__ == "__main__":
    sys.exit(ended(main))
