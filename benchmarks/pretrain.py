"""Pretrained policies of all ten environments, made at once: one process each, the cores and GPUs shared between them.

    python benchmarks/pretrain.py --out DIR [--seconds S] [--only AntFlat ...] [--net small] [--envs N] [--seed K]
                                  [--cores C] [--start DIR] [--json FILE] [--quick]

Every process is `nfc-gym pretrain`; run again, each goes on from where it stopped, `--seconds` longer. With `--start`
each begins with the weights of its policy in that folder; one of rough ground, where there is none, with those of its
flat twin (`package` stands for the policies that come with the package). Prints how each
policy does in the nominal world over 64 whole episodes, beside a policy of uniformly random actions; DIR holds the
policies, their curves and logs. `--quick` is a few seconds of JackalFlat on one core.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
from options import count, ended, json_file, number, write_json

from nfc_gym import assets
from nfc_gym.adaptation import load_policy
from nfc_gym.adaptation.evaluate import evaluate
from nfc_gym.adaptation.network import NETS
from nfc_gym.adaptation.worlds import vector_env
from nfc_gym.cli import app

ROBOTS = ("Humanoid", "Quadruped", "Quadcopter", "Ant", "Jackal")
IDS = [f"{robot}{ground}" for robot in ROBOTS for ground in ("Rough", "Flat")]
MAIN = "import sys; sys.argv[0] = 'nfc-gym'; from nfc_gym.cli import main; main()"
# Cores go where a control step costs most: relative processor time a step, measured on one core.
COST = {"Humanoid": 1.6, "Quadruped": 1.4, "Quadcopter": 0.6, "Ant": 1.2, "Jackal": 1.0}
GOALS = {"JackalFlat": 0.95, "JackalRough": 0.85, "QuadcopterFlat": 0.95, "QuadcopterRough": 0.85}  # of success


def threads(ids: list[str], cores: int) -> dict[str, int]:
    """Threads of each process; a third more in all than there are cores, since none is busy always."""
    cost = {name: COST[name.removesuffix("Flat").removesuffix("Rough")] for name in ids}
    whole = sum(cost.values())
    return {name: max(1, min(cores, round(4 / 3 * cores * c / whole))) for name, c in cost.items()}


def start(name: str, share: int, place: int, args: argparse.Namespace) -> Callable[[], int]:
    """One process, and how to wait for its exit code; where there are several GPUs they are taken in turns."""
    gpus = len([g for g in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if g]) or visible_gpus()
    env = {**os.environ, "OMP_NUM_THREADS": str(share), "OPENBLAS_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
    if gpus > 1:
        env["CUDA_VISIBLE_DEVICES"] = str(place % gpus)
    words = [
        "pretrain", name, "--out", str(args.out / f"{name}-v0.safetensors"),
        "--steps", str(args.steps), "--seconds", str(args.seconds), "--threads", str(share), "--envs", str(args.envs),
        "--net", args.net, "--seed", str(args.seed),
    ]  # fmt: skip
    if args.start is not None and (first := first_weights(name, args.start)) is not None:
        words += ["--start", str(first)]
    with open(args.out / f"{name}.txt", "a", encoding="utf-8") as log:
        if args.quick:  # one alone, which need not load the libraries again
            with redirect_stdout(log), redirect_stderr(log):
                code = app(words, standalone_mode=False) or 0
            return lambda: code
        return subprocess.Popen(
            [sys.executable, "-c", MAIN, *words], env=env, stdout=log, stderr=subprocess.STDOUT
        ).wait


def first_weights(name: str, folder: Path) -> Path | None:
    """The policy in a folder that an environment's training may begin with."""
    if str(folder) == "package":
        folder = assets.policy("x").parent
    for candidate in (name, name.replace("Rough", "Flat")):
        path = folder / f"{candidate}-v0.safetensors"
        if path.is_file():
            return path
    return None


def visible_gpus() -> int:
    """How many GPUs the driver lists; 0 without one."""
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return 0
    return len(listed.splitlines())


def random_return(name: str) -> float:
    """Mean return of uniformly random actions in the nominal world, 64 episodes."""
    envs, rng = vector_env(name, 64), np.random.default_rng(0)
    found = evaluate(lambda obs: rng.uniform(-1, 1, envs.action_space.shape), envs)
    envs.close()
    return float(found.returns.mean())


def row(name: str, out: Path) -> dict[str, object]:
    """What a policy's file says of it."""
    about = load_policy(out / f"{name}-v0.safetensors").about
    nominal, goal = about["nominal"], GOALS.get(name)
    value = nominal["success"] if goal else nominal["return"]
    unit = "success" if goal else "return"
    baseline = None if goal else random_return(name)
    return {
        "name": f"{name}: pretrained, nominal world", "value": value, "unit": unit, "baseline": baseline, "goal": goal,
        "holds": None if goal is None else value >= goal, "seeds": [about["training"]["seed"]], "nominal": nominal,
        "steps": about["steps"], "seconds": about["seconds"],
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, metavar="DIR", help="policies, curves and logs")
    parser.add_argument("--seconds", type=number(0), default=480)
    parser.add_argument("--steps", type=count(1), default=10**9)
    parser.add_argument("--only", nargs="+", choices=IDS, default=IDS)
    parser.add_argument("--net", choices=list(NETS), default="small")
    parser.add_argument("--envs", type=count(1), default=1024)
    parser.add_argument("--seed", type=count(0), default=0)
    parser.add_argument("--cores", type=count(1), default=len(os.sched_getaffinity(0)))
    parser.add_argument("--start", type=Path)
    parser.add_argument("--json", type=json_file)
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args()
    if args.quick:
        args.seconds, args.only, args.envs, args.net, args.cores = 2, ["JackalFlat"], 32, "small", 1
    elif args.out is None:
        parser.error("name a folder: --out DIR")
    with tempfile.TemporaryDirectory() as folder:
        args.out = args.out or Path(folder)
        sys.exit(trained(args))


def trained(args: argparse.Namespace) -> int:
    """Train and judge; the worst exit code."""
    args.out.mkdir(parents=True, exist_ok=True)
    shares, began = threads(args.only, args.cores), time.monotonic()
    running = {name: start(name, shares[name], k, args) for k, name in enumerate(args.only)}
    codes = {name: wait() for name, wait in running.items()}
    print(f"{time.monotonic() - began:.0f} s, cores: {args.cores}, GPUs: {visible_gpus()}")
    rows = []
    for name in args.only:
        if codes[name]:
            last = (args.out / f"{name}.txt").read_text(encoding="utf-8").splitlines()[-1:]
            print(f"{name}: exit code {codes[name]}: {' '.join(last)}")
        if (args.out / f"{name}-v0.safetensors").is_file():
            rows.append(found := row(name, args.out))
            nominal = {k: round(v, 3) for k, v in found["nominal"].items()}  # type: ignore[attr-defined]
            print(f"{name:16} {found['steps']:>12,} steps {found['seconds']:>6} s  {nominal}", end="")
            print(f"  random {found['baseline']:.1f}" if found["baseline"] is not None else f"  goal {found['goal']}")
    if args.json:
        write_json(args.json, rows)
    return max(codes.values())


if __name__ == "__main__":
    sys.exit(ended(main))
