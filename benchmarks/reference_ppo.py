"""A reference single-file PPO beside `nfc-gym pretrain`: the same environments and control steps, one core each.

    python benchmarks/reference_ppo.py --script ppo_continuous_action.py [--places AntFlat ...] [--seeds 0 1]
                                       [--methods pretrain reference] [--steps N] [--envs N] [--out DIR] [--json FILE]
                                       [--quick]

The reference is CleanRL's `ppo_continuous_action.py`, a script that knows nothing of this package and is no part of it:
get it from https://github.com/vwxyzjn/cleanrl, `pip install tyro tensorboard`, and say where it is; under Gymnasium 1
its `TransformObservation` wants `env.observation_space` as a third argument. It runs with its own settings, and sees
what policies of the package see (`Sight`): on rough ground a few cells of the elevation map beside the rest. Its actor
is then judged with its own scale of observations. What is trained here varies psi; the reference learns in the nominal
world, where both are judged: 64 whole episodes without exploring. With --out finished runs are kept. `--quick` is a few
thousand steps, of this package alone where there is no script.
"""

import argparse
import contextlib
import io
import os
import runpy
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from options import count, ended, json_file, write_json
from posteriors.keep import Kept
from timing import Table

from nfc_gym.adaptation import pretrain
from nfc_gym.adaptation.evaluate import evaluate
from nfc_gym.adaptation.sight import Sight, VectorSight
from nfc_gym.adaptation.worlds import vector_env
from nfc_gym.core.errors import InputError
from nfc_gym.envs.rotations import yaw
from nfc_gym.simulate.machine import full_id

EPISODES = 64
PLAIN = "Plain-v0"  # the id that the reference is given: an environment that shows one vector


def main(argv: Sequence[str] | None = None) -> int:
    args = parse(argv)
    methods = [m for m in args.methods if m == "pretrain" or args.script]
    if methods != args.methods:
        print("no --script: the reference is left out")
    table = Table()
    with tempfile.TemporaryDirectory() as scratch:
        kept = Kept(args.out or Path(scratch), {"steps": args.steps, "envs": args.envs})
        for place in args.places:
            found = {m: [cell(kept, m, place, seed, args) for seed in args.seeds] for m in methods}
            if "pretrain" not in found:
                continue  # nothing to compare
            means = {m: float(np.mean([f["return"] for f in rows])) for m, rows in found.items()}
            name = f"{place}: return at home after {args.steps:,} steps, mean of seeds"
            reference = means.get("reference")
            table.add(
                name, means["pretrain"], "", baseline=reference, at_least=reference, seeds=tuple(args.seeds)
            )  # fmt: skip
    if args.json:
        write_json(args.json, [asdict(row) for row in table.rows])
    return 0


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--script", type=Path, metavar="FILE", help="CleanRL's ppo_continuous_action.py")
    add("--places", nargs="+", default=["AntFlat", "QuadrupedFlat", "HumanoidFlat"], metavar="PLACE")
    add("--methods", nargs="+", choices=("pretrain", "reference"), default=["pretrain", "reference"])
    add("--seeds", type=count(0), nargs="+", default=[0, 1])
    add("--steps", type=count(1), default=600_000, help="control steps of each run")
    add("--envs", type=count(1), default=256, help="simulations of `nfc-gym pretrain`")
    add("--out", type=Path, metavar="DIR", help="keeps finished runs")
    add("--json", type=json_file, metavar="FILE")
    add("--quick", action="store_true", help="a toy")
    args = parser.parse_args(argv)
    if args.script is not None and not args.script.is_file():
        parser.error(f"--script {args.script}: no such file")
    for place in args.places:
        try:
            full_id(place)
        except InputError as error:
            parser.error(f"--places: {error}")
    if args.quick:
        args.places, args.seeds, args.steps, args.envs = ["AntFlat"], [0], 4096, 32
    if args.script is not None:
        args.script = args.script.absolute()
    return args


def cell(kept: Kept, method: str, place: str, seed: int, args: argparse.Namespace) -> dict[str, Any]:
    """One run in a process of its own, as both draw from torch's global generator and one changes the folder."""
    name = f"{method}_{place}_{seed}"

    def made() -> dict[str, Any]:
        # What a fork knows already, a toy need not load again.
        with ProcessPoolExecutor(1, get_context("fork" if args.quick else "spawn")) as pool:
            if method == "pretrain":
                return pool.submit(ours, place, seed, args.steps, args.envs).result()
            return pool.submit(theirs, place, seed, args.steps, args.script).result()

    found = kept.once(name, made)
    print(
        f"{name}: return {found['return']:.0f} +- {found['return_error']:.0f}, length {found['length']:.0f}, "
        f"{found['seconds']:.0f} s", flush=True
    )  # fmt: skip
    return found


def ours(place: str, seed: int, steps: int, envs: int) -> dict[str, Any]:
    """`nfc-gym pretrain`, as it comes."""
    with tempfile.TemporaryDirectory() as folder:
        policy = pretrain(
            place, Path(folder) / "p.safetensors", steps=steps, seed=seed, envs=envs, threads=1, device="cpu"
        )
    return policy.about["nominal"] | {"seconds": policy.about["seconds"]}


class Seen(gymnasium.ObservationWrapper):
    """An environment of this package, made with `context=["psi"]`, as its policies see it: one vector.

    The cells of the map are looked up without making the whole map, which would take most of a step.
    """

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.sight = Sight.of(env)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (self.sight.size,), np.float32)

    def observation(self, observation: Any) -> NDArray[np.float32]:
        """The vector."""
        if self.sight.cells is None:
            return self.sight.flat(observation)
        base: Any = self.unwrapped
        qpos = base.data.qpos[None]
        seen = self.sight.cells.around([base.perceived], qpos[:, :3], yaw(qpos[:, 3:7]))
        parts = [observation["proprio"], *([observation["goal"]] if self.sight.goal else []), seen.ravel()]
        return np.concatenate(parts, dtype=np.float32)


def plain(environment: str) -> gymnasium.Env:
    """What the reference is given."""
    return Seen(gymnasium.make(environment, context=["psi"]))


def theirs(place: str, seed: int, steps: int, script: Path) -> dict[str, Any]:
    """The script, with its own settings; afterwards its actor and its scale of observations are looked up in it."""
    torch.set_num_threads(1)
    gymnasium.register(PLAIN, partial(plain, full_id(place)))
    sys.argv = [str(script), "--env-id", PLAIN, "--seed", str(seed), "--total-timesteps", str(steps), "--no-cuda"]
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()):
        left = runpy.run_path(str(script), run_name="__main__")
    seconds = time.monotonic() - began
    if not {"agent", "envs"} <= left.keys():
        raise InputError(f"--script {script}: it leaves no `agent` and `envs` behind, as CleanRL's does")
    scale, actor = left["envs"].envs[0].get_wrapper_attr("obs_rms"), left["agent"].actor_mean

    def policy(observation: Any) -> NDArray[np.float32]:
        seen = (observation["observation"] - scale.mean) / np.sqrt(scale.var + 1e-8)
        with torch.no_grad():
            return actor(torch.as_tensor(np.clip(seen, -10, 10), dtype=torch.float32)).clamp(-1, 1).numpy()

    envs = VectorSight(vector_env(place, EPISODES, threads=1))
    found = evaluate(policy, envs, seed=seed + EPISODES).summary()
    envs.close()
    return found | {"seconds": seconds}


if __name__ == "__main__":
    sys.exit(ended(main))
