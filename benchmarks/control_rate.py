"""How fast the loop on the robot runs: one observation in, one action out, at batch 1 on two cores.

    python benchmarks/control_rate.py [--quick] [--robots Jackal ...] [--threads N] [--draws N] [--clock wall|cpu]
                                      [--json FILE]

Timed is what would run on the robot, not the simulation that stands in for it: the packaged policy (by torch, and as
plain arrays), an anomaly monitor beside it, and a neural posterior that is given the last window and drawn from at
every control step, which is far more often than anybody needs it. Networks have the sizes that `nfc-gym train` makes;
how well they are trained changes no time, so they hardly are. Rates are control steps over the time of a repeat's
steps, medians of repeats that take turns; below each stands the slowest step. The control period of the environments is
20 ms, 50 Hz. The replay is timed for robots whose observation is their state: Jackal and Quadcopter. The Humanoid is
timed where --robots names it, as its windows take the longest to simulate.
torch runs on one thread, the replay's physics on --threads; `--clock cpu` counts processor time, as if each of them had
a core, where other work runs beside it.
"""

import argparse
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import gymnasium
import numpy as np
import timing
import torch
from options import count, ended, json_file, write_json
from timing import Table

import nfc_gym  # noqa: F401 (registers the ids)
from nfc_gym.adaptation import load_policy
from nfc_gym.inference.config import NetworkConfig
from nfc_gym.inference.contrast import Contrast, ContrastConfig
from nfc_gym.inference.detector import WindowDetector
from nfc_gym.inference.jobs import train_posterior
from nfc_gym.inference.posterior import NeuralPosterior, Window, load
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import TrainConfig
from nfc_gym.simulate import simulate
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.replay import Replay

ROBOTS = ["Jackal", "Quadcopter", "Quadruped", "Ant", "Humanoid"]
EVERY = 25  # control steps between two replays, as docs/adaptation.md has it
REPLAYED = ("Jackal", "Quadcopter")  # what they observe is their state; the others' replay wants a state estimate
PLAIN, LOOP = 1000.0, 25.0  # Hz, the goals: the policy alone; policy, monitor and posterior
Step = Callable[[Any, Any, Any], None]  # (observation, action, next observation) of one control step


class Last:
    """The last H control steps, and a posterior that is given them."""

    def __init__(self, posterior: NeuralPosterior, horizon: int, draws: int) -> None:
        self.posterior, self.horizon, self.draws = posterior, horizon, draws
        self.rng = np.random.default_rng(0)
        self.states: list[Any] = []
        self.actions: list[Any] = []

    def update(self, observation: Any, action: Any, after: Any) -> None:
        """Keep a step; draw, once there are enough."""
        self.states = [*(self.states or [observation["proprio"]]), after["proprio"]][-self.horizon - 1 :]
        self.actions = [*self.actions, action][-self.horizon :]
        if len(self.actions) == self.horizon:
            window = Window(np.stack(self.states), np.stack(self.actions))
            self.posterior.given(window).of("psi").sample(self.draws, self.rng)


def trained(environment: str, folder: Path) -> NeuralPosterior:
    """A posterior of the size that `nfc-gym train` makes, of few windows."""
    machine = Machine(environment)
    simulate(environment, 96, folder / "windows", jobs=1, effects=0.0, per_shard=96)
    prior = PriorBox.of(machine.space, machine.kind.name)
    config = NetworkConfig(summaries=True, linear=True, delta_s=True)
    out = folder / "posterior.safetensors"
    train_posterior(folder / "windows", prior, out, config, TrainConfig(epochs=1, batch=32), device="cpu")
    return load(out)


def recorded(environment: str, act: Callable[[Any], Any], steps: int) -> list[tuple[Any, Any, Any]]:
    """What happens under a policy, to be gone through again by the clock."""
    env = gymnasium.make(environment, context=["psi"])
    out: list[tuple[Any, Any, Any]] = []
    observation, _ = env.reset(seed=0)
    while len(out) < steps:
        action = act(observation)
        after, _, ended, truncated, _ = env.step(action)
        out.append((observation, action, after))
        observation = env.reset()[0] if ended or truncated else after
    env.close()
    return out


def contestants(environment: str, folder: Path, threads: int, draws: int) -> tuple[dict[str, Step], int, Any]:
    """What is timed, by name; H; and the policy."""
    policy, posterior = load_policy(environment), trained(environment, folder)
    arrays, sizes = policy.perceptron(), posterior.network.sizes
    contrast = WindowDetector(Contrast(ContrastConfig(), sizes, posterior.prior))
    last = [Last(posterior, sizes.horizon, draws) for _ in range(2)]

    def with_(*parts: Any) -> Step:
        def step(observation: Any, action: Any, after: Any) -> None:
            policy(observation)
            for part in parts:
                part.update(observation, action, after)

        return step

    def plainly(observation: Any, action: Any, after: Any) -> None:
        arrays(policy.sight.flat(observation)[None])

    found: dict[str, Step] = {
        "policy": with_(),
        "policy, as plain arrays": plainly,
        "policy + contrastive monitor": with_(contrast),
        f"policy + contrastive monitor + posterior, {draws} draws": with_(contrast, last[0]),
    }
    if any(robot in environment for robot in REPLAYED):
        each, once, again = (WindowDetector(Replay(environment, nthread=threads), every=k) for k in (1, EVERY, EVERY))
        found |= {
            "policy + replay monitor": with_(each),
            "policy + replay monitor each 0.5 s": with_(once),
            f"policy + replay monitor each 0.5 s + posterior, {draws} draws": with_(again, last[1]),
        }
    return found, sizes.horizon, policy


def seconds(step: Step, motion: list[tuple[Any, Any, Any]]) -> list[float]:
    """Of each control step."""
    out, clock = [], timing.clock()
    for part in motion:
        began = clock()
        step(*part)
        out.append(clock() - began)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--quick", action="store_true", help="one robot, few steps")
    add("--robots", nargs="+", type=str.capitalize, choices=ROBOTS, default=ROBOTS[:4])
    add("--threads", type=count(0), default=2, help="of the replays' physics")
    add("--draws", type=count(1), default=100, help="of psi from the posterior, each step")
    add("--repeats", type=count(0), default=5)
    add("--clock", choices=("wall", "cpu"), default="wall", help="cpu: processor time, where cores are shared")
    add("--json", type=json_file, metavar="FILE", help="rows {name, value, unit, baseline, goal, holds, seeds}")
    args = parser.parse_args()
    timing.use_clock(args.clock)
    torch.set_num_threads(1)
    robots, repeats = (["Jackal"], 0) if args.quick else (args.robots, args.repeats)
    threads, draws = (1, 10) if args.quick else (args.threads, args.draws)
    timed = 3 if args.quick else EVERY
    table = Table()
    for robot in robots:
        with tempfile.TemporaryDirectory() as folder:
            measure(table, robot, Path(folder), threads, draws, repeats, timed)
    if args.json:
        write_json(args.json, [asdict(r) for r in table.rows])


def measure(table: Table, robot: str, folder: Path, threads: int, draws: int, repeats: int, timed: int) -> None:
    """Rows of one robot, of so many timed steps."""
    named, horizon, policy = contestants(f"nfc_gym/{robot}Flat-v0", folder, threads, draws)
    motion = recorded(f"nfc_gym/{robot}Flat-v0", policy, horizon + timed)
    taken: dict[str, list[list[float]]] = {name: [] for name in named}
    for _ in range(repeats + 1):
        for name, step in named.items():
            # Monitors and posteriors have a whole window from the H-th step on.
            taken[name].append(seconds(step, motion)[horizon:])
    plain = 0.0
    for name, runs in taken.items():
        runs = runs[1:] or runs  # the first turn warms up; a quick run has no other
        rate = 1 / statistics.median(statistics.fmean(r) for r in runs)
        slow = max(max(r) for r in runs)
        plain = plain or rate
        goal = PLAIN if name == "policy" else LOOP if "posterior" in name else None
        table.add(f"{robot}: {name}", rate, "Hz", baseline=plain, at_least=goal)
        print(f"{'':68} slowest step {1e3 * slow:.3g} ms", flush=True)


if __name__ == "__main__":
    began = time.monotonic()
    code = ended(main)
    print(f"{time.monotonic() - began:.0f} s, load of the machine {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    sys.exit(code)
