"""Neural posteriors on problems whose posterior is known, and how long they take.

    python benchmarks/inference.py [--quick] [--tasks linear_gaussian two_moons slcp] [--densities score mixture flow]
                                   [--seeds 0 1 2] [--simulations N] [--observations N] [--samples N] [--json FILE]
                                   [--no-mirror] [--no-latency] [--steps] [--clock wall|cpu] [--device cpu|cuda]

C2ST is the accuracy of a classifier between posterior draws and exact ones, 0.5 being perfect; its baseline column is
the same classifier between two sets of exact draws. Every seed is a network and simulations of its own,
and judged on the same observations, drawn from the prior predictive. SLCP's four draws are shown in other orders in
each pass, as windows of robots are in mirrors, but with `--no-mirror`. `--quick` ends within a minute and says little.
"""

import argparse
import os
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import asdict

os.environ.setdefault("OMP_NUM_THREADS", "1")  # a second thread waits for its core whenever another process has it

import numpy as np
import torch
from known.c2st import c2st
from known.tasks import TASKS, LinearGaussian, Task
from numpy.typing import NDArray
from options import count, ended, json_file, write_json
from timing import Table, race, use_clock

from nfc_gym.core import Fidelity
from nfc_gym.inference.config import NetworkConfig, Sizes
from nfc_gym.inference.data import TensorWindows
from nfc_gym.inference.network import Network
from nfc_gym.inference.posterior import NeuralPosterior, Window
from nfc_gym.inference.progress import Quiet, Spoken, quiet
from nfc_gym.inference.random import mixed
from nfc_gym.inference.reflection import Reflection
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.train import TrainConfig, train

Array = NDArray[np.float64]
GOALS = {"linear_gaussian_5": 0.52, "linear_gaussian_10": 0.52, "two_moons": 0.53, "slcp": 0.66}
NETWORK = NetworkConfig(encoder="nn", width=128, features=0, hidden=128, depth=4, draws=2)
TRAINING = TrainConfig(epochs=100, batch=128, rate=1e-3, patience=25)
STEPS = 20  # of the score model's sampler
TIMED = {"cpu": 4, "cuda": 64}  # training steps an epoch, of which the first epoch is not timed


def windows_of(task: Task, n: int, seed: int) -> TensorWindows:
    """`n` simulations: an observation is a window of one state and no action."""
    rng = np.random.default_rng(mixed(seed, 1))
    u = rng.uniform(size=(n, len(task.box)))
    x = task.simulate(task.box.psi_of(u), rng)
    state, psi = torch.as_tensor(x[:, None], dtype=torch.float32), torch.as_tensor(u, dtype=torch.float32)
    return TensorWindows({"states": state, "actions": torch.zeros(n, 0, 0), "psi": psi})


def seen(x: Array) -> Window:
    """One observation as a window."""
    return Window(x[None], np.zeros((0, 0)))


def posterior_of(
    task: Task, density: str, linear: bool, n: int, epochs: int, seed: int, mirrored: bool
) -> NeuralPosterior:
    """A network trained on `n` simulations, in the task's mirrors too or not, a twentieth of them held out."""
    every = windows_of(task, n, seed)
    config = NetworkConfig(**{**NETWORK.to_dict(), "density": density, "linear": linear})
    network = Network(config, Sizes.of(every.tensors), task.box, seed)
    training = TrainConfig(**{**asdict(TRAINING), "seed": seed, "epochs": epochs})
    report = Spoken() if sys.stderr.isatty() else quiet
    mirror = Reflection(task.mirrors) if mirrored and task.mirrors else None
    outcome = train(network, *every.split(0.05), training, report=report, mirror=mirror)
    print(f"{task.name}: {density}, seed {seed}: {outcome.stopped} after {len(outcome.train)} epochs, "
          f"best {outcome.best}, {outcome.seconds:.0f} s", flush=True)  # fmt: skip
    return NeuralPosterior(network)


def known(table: Table, task: Task, density: str, linear: bool, args: argparse.Namespace) -> None:
    """One task and one density: C2ST of every seed, and of the seeds' mean."""
    rng = np.random.default_rng(12345)
    observed = task.simulate(task.box.psi_of(rng.uniform(size=(args.observations, len(task.box)))), rng)
    exact = [task.posterior(x, args.samples, rng) for x in observed]
    floor = statistics.mean(
        c2st(a, task.posterior(x, args.samples, rng)) for a, x in zip(exact[:2], observed, strict=False)
    )
    how = f"{' on the linear base' if linear else ''}{', in mirrors' if args.mirror and task.mirrors else ''}"
    name = f"{task.name}, {density}{how}, {args.simulations} simulations"
    scores, misses = [], []
    for seed in args.seeds:
        posterior = posterior_of(task, density, linear, args.simulations, args.epochs, seed, args.mirror)
        each, wrong = [], []
        for x, truth in zip(observed, exact, strict=True):
            given = posterior.given(seen(x))
            steps = {"steps": STEPS} if density == "score" else {}
            drawn = given.sample(args.samples, np.random.default_rng(seed), **steps).psi
            each.append(c2st(truth, drawn))
            if isinstance(task, LinearGaussian):
                away = given.log_prob(Fidelity(truth[:500])) - task.log_prob(truth[:500], x)
                wrong.append((away.mean(), np.abs(away).mean()))
        scores.append(statistics.mean(each))
        table.add(f"{name}: C2ST, seed {seed}", scores[-1], "accuracy", baseline=floor, seeds=(seed,))
        if wrong:
            signed, absolute = (statistics.mean(w) for w in zip(*wrong, strict=True))
            misses.append(abs(signed))
            table.add(f"{name}: log_prob less the closed form, mean, seed {seed}", signed, "nats", seeds=(seed,))
            table.add(f"{name}: the same, mean size at a point, seed {seed}", absolute, "nats", seeds=(seed,))
    goal = GOALS[task.name] if density == "score" and args.simulations == 10_000 else None
    seeds = tuple(args.seeds)
    table.add(f"{name}: C2ST, mean", statistics.mean(scores), "accuracy", baseline=floor, at_most=goal, seeds=seeds)
    if misses:
        table.add(f"{name}: log_prob less the closed form, mean, worst seed", max(misses), "nats",
                  at_most=0.05 if goal else None, seeds=seeds)  # fmt: skip


def latency(table: Table, turns: int, clock: str, device: str) -> None:
    """From a window of a Jackal's size (H = 50, s = 15, a = 2, d = 17) to 100 samples of psi, encoder included."""
    names = tuple(f"p{i}" for i in range(17))
    box = PriorBox("latency", names, ("1",) * 17, (0.0,) * 17, (1.0,) * 17)
    rng = np.random.default_rng(0)
    window = Window(rng.normal(size=(51, 15)), rng.normal(size=(50, 2)))
    contestants: dict[str, Callable[[], object]] = {}
    for config in (NetworkConfig(), NetworkConfig(summaries=True, linear=True), NetworkConfig(density="flow")):
        posterior = NeuralPosterior(Network(config, Sizes(50, 15, 2), box)).to(device)
        name = f"100 samples of 17 psi: {config.encoder}{' + summaries' if config.summaries else ''}, {config.density}"
        contestants[name] = lambda posterior=posterior: posterior.given(window).sample(100, rng)
    maps = NeuralPosterior(Network(NetworkConfig(elevation=True, delta_e=True), Sizes(50, 15, 2), box)).to(device)
    seen = maps.given(Window(window.states, window.actions, rng.normal(0.0, 0.05, (128, 128))))
    contestants["8 samples of 17 psi and of delta_e"] = lambda: seen.sample(8, rng)
    for name, seconds in race(contestants, turns).items():
        place = f"{torch.get_num_threads()} threads" if device == "cpu" else torch.cuda.get_device_name(device)
        what = f"latency, {name}, batch 1, {place}, {clock} time"
        goal = 40.0 if device == "cpu" else 2.0
        table.add(what, 1e3 * seconds, "ms", at_most=goal if "score" in name else None)


class Ends(Quiet):
    """When epochs ended."""

    def __init__(self) -> None:
        self.seconds: list[float] = []

    def epoch(self, done: int, of: int, train: float, held_out: float) -> None:
        """Another one."""
        self.seconds.append(time.perf_counter())


def steps(table: Table, device: str, batches: list[int], epochs: int = 4) -> None:
    """Training steps on random windows of a Jackal's size, with CUDA graphs and without; median of the epochs."""
    names = tuple(f"p{i}" for i in range(17))
    box = PriorBox("steps", names, ("1",) * 17, (0.0,) * 17, (1.0,) * 17)
    place = "cpu" if device == "cpu" else torch.cuda.get_device_name(device)
    for size in batches:
        each, chance = TIMED[torch.device(device).type], torch.Generator().manual_seed(0)
        shapes = {"states": (51, 15), "actions": (50, 2), "psi": (17,)}
        drawn = {k: torch.rand((each + 1) * size, *s, generator=chance) for k, s in shapes.items()}
        held_out, windows = (TensorWindows({k: t[part] for k, t in drawn.items()})
                             for part in (slice(size), slice(size, None)))  # fmt: skip
        for config in (NetworkConfig(summaries=True), NetworkConfig(density="mixture"), NetworkConfig(density="flow")):
            found = {}
            for graph in (False, True) if device != "cpu" else (False,):
                training, ends = TrainConfig(epochs=epochs, batch=size, mixed=False, graph=graph), Ends()
                network = Network(config, Sizes.of(windows.tensors), box)
                train(network, windows, held_out, training, device=device, report=ends)
                found[graph] = 1e3 / each * statistics.median(np.diff(ends.seconds))
            what = (
                f"{config.encoder}{' + summaries' if config.summaries else ''}, {config.density}, batch {size}, {place}"
            )
            table.add(f"training step, {what}", found[max(found)], "ms", baseline=found[False])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--tasks", nargs="*", choices=TASKS, default=list(TASKS),
        help="problems whose posterior is known; default all, none asks for the latency alone")  # fmt: skip
    add("--densities", nargs="+", choices=("score", "mixture", "flow"), default=["score"], help="default score")
    add("--base", choices=("linear", "prior", "both"), default="both",
        help="where densities start (default %(default)s)")  # fmt: skip
    add("--seeds", nargs="+", type=count(0), default=[0, 1, 2],
        help="of a network and its simulations each; default 0 1 2")  # fmt: skip
    add("--simulations", type=count(1), default=10_000, help="that a network learns from (default %(default)s)")
    add("--observations", type=count(1), default=10, help="that it is judged on (default %(default)s)")
    add("--samples", type=count(1), default=10_000,
        help="draws an observation, and as many exact ones (default %(default)s)")  # fmt: skip
    add("--mirror", action=argparse.BooleanOptionalAction, default=True,
        help="show simulations in the mirrors that a problem has")  # fmt: skip
    add("--epochs", type=count(1), default=TRAINING.epochs,
        help="passes over the simulations at most (default %(default)s)")  # fmt: skip
    add("--latency", action=argparse.BooleanOptionalAction, default=True, help="time a window of a Jackal's size too")
    add("--steps", nargs="*", type=count(1), metavar="BATCH",
        help="time training steps of so many windows too, with CUDA graphs and without; none is 256 1024")  # fmt: skip
    add("--clock", choices=("wall", "cpu"), default="wall",
        help="of the latency; cpu on a busy machine (default %(default)s)")  # fmt: skip
    parser.add_argument("--device", default="cpu", help="of the latency and of training steps (default cpu)")
    parser.add_argument("--quick", action="store_true", help="one seed, few simulations and observations: a minute")
    parser.add_argument(
        "--json",
        type=json_file,
        metavar="FILE",
        help="write the rows here: a list of {name, value, unit, baseline, goal, holds, seeds}",
    )
    args = parser.parse_args()
    use_clock(args.clock)
    if args.quick:
        args.seeds, args.simulations, args.observations, args.samples, args.epochs = [0], 256, 1, 100, 1
        args.base = "linear"
    print(f"torch {torch.__version__}, {torch.get_num_threads()} threads")
    table = Table()
    for key in args.tasks:
        for task in TASKS[key]:
            for density in args.densities:
                for linear in {"linear": (True,), "prior": (False,), "both": (True, False)}[args.base]:
                    known(table, task, density, linear, args)
    if args.latency:
        latency(table, 1 if args.quick else 25, args.clock, args.device)
    if args.steps is not None:
        steps(table, args.device, args.steps or [256, 1024], 2 if args.quick else 4)
    if args.json:
        write_json(args.json, [asdict(r) for r in table.rows])


if __name__ == "__main__":
    sys.exit(ended(main))
