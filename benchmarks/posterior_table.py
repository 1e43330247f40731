"""The paper's Table I: posteriors of a simulator's parameters by robot, ground and method, beside their ceiling.

    python benchmarks/posterior_table.py --out DIR [--robots Jackal Ant ...] [--terrain Flat Rough] [--windows 100000]
        [--methods mdn-rff mdn-tcn sde-nn sde-rff sde-fks sde-tcn flow-tcn sbi-npe sbi-npse]
        [--inputs window summaries] [--effects 0] [--seeds 0] [--epochs 100] [--budget SECONDS]
        [--extras ceiling residuals motion axle rounds plots] [--json FILE]
    python benchmarks/posterior_table.py --quick

Windows are simulated once into DIR and used by every method; a cell (robot, ground, method, inputs, seed) that is
finished is kept in DIR/cells, and one that was interrupted goes on from its last saved state, so that the same
command may be given again and again until all is there. `--budget` is the training time of a cell by the clock:
the step size of ours falls to 0 as it is used up, sbi's stop after the epoch in which it is. `--stop SECONDS` begins
no new cell after that time.
DIR/table.md is written anew after every cell from all that there are; several of these commands may work on one DIR
at the same time, as `posterior_queue.py` has them do. `--quick` is a toy in a temporary folder, whose figures mean
nothing.

The windows are of the simulator as it is, as the ceiling's are; `--effects 0.5` gives half of them an effect that the
model lacks. The residual heads learn from windows of their own, of which half have one: `residuals` all of them from
motion and maps, `motion` those of delta_s and of structure from motion alone.

Gain is the mean log density of the true parameters on windows not trained on, in nats a parameter, the prior having 0.
"""

import argparse
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # a second thread waits for its core whenever another process has it

import torch
from options import count, ended, json_file, number, write_json
from posteriors import extras, plots, report
from posteriors.cases import WAYS
from posteriors.ceilings import ceiling_of
from posteriors.fit import Plan, fit
from posteriors.judge import judge, latency
from posteriors.keep import Kept, write_text
from posteriors.methods import INPUTS, METHODS, cell_name, possible
from posteriors.paper import ROBOTS, TERRAINS
from posteriors.sets import Sets, environment, prior_of

from nfc_gym.core.errors import MissingExtra
from nfc_gym.inference.progress import Spoken

EXTRAS = ("ceiling", "residuals", "motion", "axle", "rounds", "plots")


@dataclass(frozen=True)
class Run:
    """What a command asks for, and until when it may begin something new."""

    args: argparse.Namespace
    kept: Kept
    plan: Plan
    device: torch.device
    ends: float

    def folder(self, name: str) -> Path:
        """Where the training of that name keeps its state."""
        return self.kept.folder(name)

    @property
    def over(self) -> bool:
        """Whether it is too late to begin something."""
        return time.monotonic() > self.ends

    def sets(self, robot: str, terrain: str) -> Sets:
        """Its windows, which are simulated where they are not there and held on the device when they are needed."""
        args, env = self.args, environment(robot, terrain)
        return Sets(
            args.data, env, args.windows, args.judges, args.effects, "map" in args.inputs, args.jobs, self.device
        )

    def show(self) -> str:
        """Write the table of all that there is, and give it."""
        text = report.table(self.kept.values())
        write_text(self.args.out / "table.md", text)
        return text


def main() -> None:
    """Command line."""
    args = _arguments()
    with tempfile.TemporaryDirectory() as folder:
        args.out = args.out or Path(folder)
        args.data = args.data or args.out
        device = torch.device("cuda" if args.device == "auto" and torch.cuda.is_available() else args.device
                              if args.device != "auto" else "cpu")  # fmt: skip
        plan = Plan(
            args.epochs, args.budget, args.batch, args.rate, args.draws, args.small, args.mirror, not args.adamw,
            args.compile, args.hidden, args.bf16,
        )  # fmt: skip
        kept = Kept(args.out, {"judges": args.judges, "samples": args.samples, **plan.settings})
        run = Run(args, kept, plan, device, time.monotonic() + args.stop if args.stop else float("inf"))
        print(f"torch {torch.__version__} on {device}, {torch.get_num_threads()} threads, {args.out}", flush=True)
        for robot in args.robots:
            for terrain in args.terrain:
                if run.over:
                    print("time is up: the same command goes on")
                else:
                    robot_on(run, robot, terrain)
        print(run.show())
        if args.json:
            write_json(args.json, kept.values())


def robot_on(run: Run, robot: str, terrain: str) -> None:
    """Every cell of one environment, then what else was asked for."""
    args, env, sets = run.args, environment(robot, terrain), run.sets(robot, terrain)
    for seed in args.seeds:
        for inputs in args.inputs:
            for method in args.methods:
                if not run.over and not possible(METHODS[method], inputs):
                    run.kept.once(
                        cell_name(robot + terrain, method, inputs, seed),
                        lambda m=method, i=inputs, s=seed: cell(run, env, m, i, s, sets),
                        trained_on=args.windows, effects=args.effects,
                    )  # fmt: skip
                    run.show()
    if "ceiling" in args.extras and not run.over:
        run.kept.once(f"{robot}{terrain}_ceiling", lambda: ceiling_of(
            args.data, env, sets.judged, args.ceiling_windows, args.jobs, *args.ceiling_draws))  # fmt: skip
    for extra in args.extras:
        if extra != "ceiling" and not run.over:
            extras.EXTRAS[extra](run, robot, terrain, sets)
            run.show()


def cell(run: Run, env: str, method: str, inputs: str, seed: int, sets: Sets) -> dict[str, Any]:
    """Train and judge one method; a peer that is not installed says so instead, and is tried again."""
    prior, folder = prior_of(env), run.folder(cell_name(env[8:-3], method, inputs, seed))
    spoken = Spoken()
    spoken.message(f"{env}: {METHODS[method].name}, {inputs}, seed {seed}")
    try:
        done = fit(method, inputs, sets.windows, prior, run.plan, seed, folder, run.device, spoken)
    except MissingExtra as e:
        return {"missing": str(e)}
    judges = sets.judges
    plots.keep_draws(done.fitted, judges, folder)
    few = min(run.args.judges, run.args.peer_judges) if method == "sbi-npse" else None
    found = judge(done.fitted, judges, prior, run.args.samples, few)
    out = done.outcome
    return found | {
        "epochs": len(out.held_out), "planned": done.epochs, "best": out.best, "stopped": out.stopped,
        "seconds": out.seconds, "latency_ms": latency(done.fitted, judges), "device": str(run.device),
        "threads": torch.get_num_threads(),
    }  # fmt: skip


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder for windows, cells and tables")
    parser.add_argument("--data", type=Path, help="folder for windows and ceilings, where several DIR share them")
    parser.add_argument(
        "--robots", nargs="+", type=str.capitalize, choices=ROBOTS, default=list(ROBOTS), help="default all"
    )
    parser.add_argument("--terrain", nargs="+", choices=TERRAINS, default=list(TERRAINS), help="default both")
    parser.add_argument(
        "--methods", nargs="*", choices=list(METHODS), default=list(METHODS),
        help="density and encoder of each column; sbi-... are the package sbi's; default all, none trains nothing",
    )  # fmt: skip
    parser.add_argument(
        "--inputs", nargs="+", choices=list(INPUTS), default=["window", "summaries"],
        help="what networks see: the window of motion, beside it physics summaries, with these a linear start, or "
        "the map; default window summaries",
    )  # fmt: skip
    parser.add_argument(
        "--extras", nargs="*", choices=EXTRAS, default=["ceiling"],
        help="done after an environment's cells: its ceiling, residual heads with maps or of motion alone, windows "
        "with a lost axle, sequential rounds, pictures; default ceiling",
    )  # fmt: skip
    parser.add_argument(
        "--seeds", nargs="+", type=count(0), default=[0], help="of networks and training, a cell each; default 0"
    )
    parser.add_argument(
        "--windows", type=count(1), default=100_000, help="to train on an environment (default %(default)s)"
    )
    parser.add_argument(
        "--effects",
        type=number(0, 1),
        default=0.0,
        help="share of the windows with an effect not in the model, 0 to 1 (default %(default)s)",
    )
    parser.add_argument(
        "--residual-windows",
        type=count(0),
        default=20_480,
        help="windows that the residual heads learn from (default %(default)s)",
    )
    parser.add_argument(
        "--judges",
        type=count(1),
        default=2000,
        help="windows not trained on, by which all are judged (default %(default)s)",
    )
    parser.add_argument(
        "--peer-judges",
        type=count(1),
        default=200,
        help="of those, for NPSE, whose densities take long (default %(default)s)",
    )
    parser.add_argument(
        "--samples",
        type=count(1),
        default=512,
        help="draws of psi a window, by which it is judged (default %(default)s)",
    )
    parser.add_argument(
        "--epochs", type=count(1), default=100, help="passes over the windows at most (default %(default)s)"
    )
    parser.add_argument(
        "--budget", type=number(0), default=0, metavar="SECONDS", help="of training a cell; default 0 sets none"
    )
    parser.add_argument(
        "--stop",
        type=number(0),
        default=0,
        metavar="SECONDS",
        help="begin nothing new after these; default 0 sets no end",
    )
    parser.add_argument("--batch", type=count(1), default=256, help="windows a training step (default %(default)s)")
    parser.add_argument("--rate", type=number(0), default=5e-4, help="largest step size (default %(default)s)")
    parser.add_argument(
        "--draws",
        type=count(1),
        default=8,
        help="of noise a window and training step, of score models (default %(default)s)",
    )
    parser.add_argument("--small", action="store_true", help="networks of a toy's size")
    parser.add_argument(
        "--mirror",
        action="store_true",
        help="show half of each step's windows in each mirror of the robot; sbi's methods see none",
    )
    parser.add_argument("--adamw", action="store_true", help="change matrices by AdamW too, in place of Muon")
    parser.add_argument(
        "--hidden", type=count(1), default=256, help="width of the densities' layers (default %(default)s)"
    )
    parser.add_argument("--bf16", action="store_true", help="train in bfloat16 on a GPU, in place of 19 bits")
    parser.add_argument(
        "--compile", action="store_true", help="compile training steps first, which takes part of the budget"
    )
    parser.add_argument(
        "--jobs", type=count(0), default=0, help="processes of the simulation; default 0 takes all cores"
    )
    parser.add_argument(
        "--device", default="auto", help="cpu, cuda, or auto, a GPU where there is one (default %(default)s)"
    )
    parser.add_argument(
        "--ceiling-windows", type=count(1), default=8, help="that a ceiling is the mean of (default %(default)s)"
    )
    parser.add_argument(
        "--ceiling-draws", nargs=2, type=count(1), default=[256, 32], metavar=("CLOUD", "PAIRS"),
        help="of the motors' noise a window: for what it spreads, and a parameter for slopes (default 256 32)",
    )  # fmt: skip
    parser.add_argument(
        "--truths", type=count(1), default=20, help="windows that sequential rounds infer (default %(default)s)"
    )
    parser.add_argument(
        "--round", type=count(1), default=10_000, help="simulations a sequential round (default %(default)s)"
    )
    parser.add_argument(
        "--ways", nargs="+", choices=list(WAYS), default=["on"],
        help="in which second rounds train, or refined, simulations of the window's own commands instead (default on)",
    )  # fmt: skip
    parser.add_argument(
        "--few",
        type=count(1),
        default=200,
        help="windows that are replayed, or whose maps are drawn (default %(default)s)",
    )
    parser.add_argument("--axles", type=count(0), default=100, help="windows with a lost axle (default %(default)s)")
    parser.add_argument("--quick", action="store_true", help="a toy: Jackal on flat ground, in a minute")
    parser.add_argument("--json", type=json_file, metavar="FILE",
                        help="write all results of DIR here: {name: {figure: value}}")  # fmt: skip
    args = parser.parse_args()
    if args.out is None and not args.quick:
        parser.error("name a folder: --out DIR")
    if args.quick:
        args.robots, args.terrain, args.inputs, args.extras = ["Jackal"], ["Flat"], ["window"], ["ceiling"]
        args.methods = [m for m in args.methods if m != "sbi-npse"]  # its 500 steps a draw take minutes on a processor
        args.windows, args.judges, args.samples, args.epochs, args.small = 128, 32, 32, 1, True
        args.ceiling_windows, args.ceiling_draws, args.jobs, args.peer_judges = 1, [16, 4], 1, 8
    return args


if __name__ == "__main__":
    sys.exit(ended(main))
