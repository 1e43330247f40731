"""TD-MPC2 as built here beside its authors' published returns, on tasks of the DeepMind Control Suite.

    python benchmarks/tdmpc2_published.py --task cartpole-swingup --steps 200000 --seeds 0 1 2 --device cuda --out DIR
    python benchmarks/tdmpc2_published.py --task pendulum-swingup --net toy --steps 20000
    python benchmarks/tdmpc2_published.py --quick

Steps are of the simulation, two a control step, as the authors count them. The published network is `--net 5M`, with
one simulation and one update a control step. At each step count that the authors' results have, and at the end, ten
episodes are played without exploring. With --out a run that was stopped goes on, and its curve is kept.
"""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MUJOCO_GL", "disable")  # nothing is drawn, and the suite looks for a display when it is imported

import numpy as np
import torch
from options import count, ended, json_file, write_json
from timing import Table

EPISODES = 10  # at each point, as the authors


def main(argv: Sequence[str] | None = None) -> int:
    args = parse(argv)
    if find_spec("dm_control") is None:
        print("tdmpc2_published: skipped, dm_control is not installed: pip install 'nfc_gym[bench]'")
        return 0
    if args.quick:
        args.net, args.steps, args.seeds, args.every, args.episodes, args.batch = "toy", 600, [0], 600, 2, 64
    from tdmpc2.suite import PUBLISHED

    table = Table()
    with tempfile.TemporaryDirectory() as folder:
        args.out = args.out or Path(folder)
        curves = {seed: curve(args, seed) for seed in args.seeds}
    theirs = PUBLISHED.get(args.task, {})
    for at in sorted({s for c in curves.values() for s, _ in c}):
        found = [v for c in curves.values() for s, v in c if s == at]
        known = float(np.mean(theirs[at])) if at in theirs else None
        table.add(f"{args.task} {args.net}, return at {at:,} steps", float(np.mean(found)), "1", baseline=known,
                  seeds=tuple(args.seeds))  # fmt: skip
        print(f"    each seed {[round(v, 1) for v in found]}, published {list(theirs.get(at, ()))}", flush=True)
    if args.json:
        write_json(args.json, [asdict(row) for row in table.rows])
    return 0


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--task", default="cartpole-swingup", help="cartpole-swingup, pendulum-swingup, reacher-easy, or any other")
    add("--net", default="5M", help="5M, 1M (the authors' sizes) or toy")
    add("--steps", type=count(1), default=200_000, help="of the simulation")
    add("--every", type=count(1), default=100_000, metavar="STEPS", help="between two points of the curve")
    add("--seeds", nargs="+", type=count(0), default=[0])
    add("--batch", type=count(1), metavar="N", help="sequences an update; default the published 256")
    add("--episodes", type=count(1), default=EPISODES, help="at each point")
    add("--device", default="auto")
    add("--out", type=Path, metavar="DIR")
    add("--json", type=json_file, metavar="FILE")
    add("--quick", action="store_true")
    return parser.parse_args(argv)


def curve(args: argparse.Namespace, seed: int) -> list[tuple[int, float]]:
    """(steps, mean return) of one seed; a stopped run goes on after the last point that it kept."""
    from rich.console import Console
    from tdmpc2.agent import Agent
    from tdmpc2.collecting import sizes_of
    from tdmpc2.run import Run, Schedule
    from tdmpc2.settings import discount, settings_of
    from tdmpc2.suite import EPISODE, REPEAT, suite_envs
    from tdmpc2.world_model import WorldModel

    from nfc_gym.adaptation.evaluate import evaluate
    from nfc_gym.adaptation.record import Record
    from nfc_gym.inference.jobs import device_of

    torch.manual_seed(seed)
    envs, judged = suite_envs(args.task, 1), suite_envs(args.task, args.episodes)
    sizes, name = sizes_of(envs), f"{args.task}_{args.net}_{seed}"
    settings = settings_of(args.net, sizes.action, episodic=False)
    settings = settings if args.batch is None else replace(settings, batch=args.batch)
    model = WorldModel(sizes, settings).to(device_of(args.device)).eval()
    schedule = Schedule(seed=seed, first=EPISODE // 2 if args.quick else 5 * EPISODE)
    record = Record(args.out / f"{name}.log", Console(stderr=True))
    run = Run(envs, model, discount(EPISODE), schedule, most=args.steps // REPEAT, record=record)
    state, kept = args.out / f"{name}.training", args.out / f"{name}.json"
    points: list[tuple[int, float]] = []
    if state.is_file():
        run.load(state)
        points = [(s, v) for s, v in json.loads(kept.read_text())]
    agent = Agent(model, discount(EPISODE))
    goals = sorted({*range(0, args.steps, args.every), args.steps})
    for goal in [g for g in goals if not points or g > points[-1][0]]:
        run.train(goal // REPEAT, state=state)
        agent.begin(args.episodes)
        points.append((goal, float(evaluate(agent, judged, seed=10_000 + seed).returns.mean())))
        record.say(f"{name}: return {points[-1][1]:.1f} at {goal:,} steps, {run.elapsed:.0f} s of training")
        kept.write_text(json.dumps(points))
    agent.save(args.out / f"{name}.safetensors")
    return points


if __name__ == "__main__":
    sys.exit(ended(main))
