"""World models of TD-MPC2 for the tables of `policies.py`, pretrained under random psi and terrain, one after another.

    python benchmarks/tdmpc2_pretrain.py --out DIR --only JackalFlat AntFlat --steps 1000000 --device cuda
    python benchmarks/tdmpc2_pretrain.py --out DIR --only JackalRough --start DIR --seconds 300 --device cuda --compile
    python benchmarks/tdmpc2_pretrain.py --quick

DIR gets `<Place>.safetensors` for each, its state and its curves; the same command goes on with what was stopped.
With `--start` each begins with the weights of its world model in that folder; one of rough ground, where there is
none, with those of its flat twin. A GPU replays updates and plans as CUDA graphs (not with `--plain`); `--compile` has
torch's compiler fuse their kernels first, a minute or two. Planning for one robot takes about 37 GFLOP a control step
with the published network (`--net 5M`): use a GPU. Prints how each does in the nominal world, beside a policy of random
actions. `--quick` is a tiny network that learns nothing.
"""

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import torch
from options import count, ended, json_file, number, write_json
from pretrain import IDS, random_return
from rich.console import Console
from tdmpc2.pretraining import Pretraining, pretrain
from tdmpc2.settings import NETS
from tdmpc2.speed import Speed
from timing import Table

from nfc_gym.adaptation.ppo import Diverged
from nfc_gym.core.errors import InputError


def main(argv: Sequence[str] | None = None) -> int:
    args = parse(argv)
    if args.threads:
        torch.set_num_threads(args.threads)
    first = 500 if args.quick else 0
    arguments = Pretraining(seed=args.seed, envs=args.envs, first=first, ratio=args.ratio, net=args.net,
                            episodes=args.episodes, task=args.task)  # fmt: skip
    speed = Speed(graphs=not args.plain, compiled=args.compile)
    table, code = Table(), 0
    with tempfile.TemporaryDirectory() as folder:
        out = args.out or Path(folder)
        for place in args.only:
            try:
                agent = pretrain(
                    place, out / f"{place}.safetensors", arguments, steps=args.steps, seconds=args.seconds,
                    device=args.device, threads=args.threads, console=Console(), start=first_weights(place, args.start),
                    speed=speed,
                )  # fmt: skip
            except Diverged as error:
                print(error, flush=True)
                code = 1
                continue
            found = agent.about["nominal"]
            table.add(f"{place}: TD-MPC2, return in the nominal world", found["return"], "1",
                      baseline=None if args.bare else random_return(place), seeds=(args.seed,))  # fmt: skip
            if "success" in found:
                table.add(f"{place}: TD-MPC2, success", found["success"], "share", seeds=(args.seed,))
    if args.json:
        write_json(args.json, [asdict(row) for row in table.rows])
    return code


def first_weights(place: str, folder: Path | None) -> Path | None:
    """The world model in a folder that a place's training may begin with."""
    if folder is None:
        return None
    for candidate in (place, place.replace("Rough", "Flat")):
        if (folder / f"{candidate}.safetensors").is_file():
            return folder / f"{candidate}.safetensors"
    raise InputError(f"--start {folder}: no world model of {place} or of its flat twin is there")


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--out", type=Path, metavar="DIR")
    add("--only", nargs="+", choices=IDS, default=["JackalFlat", "JackalRough", "AntFlat", "AntRough"], metavar="PLACE")
    add("--steps", type=count(1), default=1_000_000, help="control steps of all simulations of a place together")
    add("--seconds", type=number(0), help="of each place, whichever is used up first")
    add("--envs", type=count(1), default=64)
    add("--ratio", type=number(0), default=0.25, help="updates a control step; the published one is 1")
    add("--net", choices=list(NETS), default="5M")
    add("--episodes", type=count(1), default=16, help="that judge each")
    add("--task", choices=("goal", "figure8"), help="of the Jackal")
    add("--start", type=Path, metavar="DIR")
    add("--device", default="auto")
    add("--bare", action="store_true", help="without the random policy beside, which has the first task")
    add("--compile", action="store_true")
    add("--plain", action="store_true", help="a GPU is told every kernel: for comparing")
    add("--threads", type=count(0), default=0, help="of the physics; 0 is all")
    add("--seed", type=count(0), default=0)
    add("--json", type=json_file, metavar="FILE")
    add("--quick", action="store_true")
    args = parser.parse_args(argv)
    if args.quick:
        args.only, args.net, args.steps = ["JackalFlat"], "tiny", 1_000
        args.envs, args.episodes, args.threads = 16, 1, 1
    elif args.out is None:
        parser.error("name a folder: --out DIR")
    return args


if __name__ == "__main__":
    sys.exit(ended(main))
