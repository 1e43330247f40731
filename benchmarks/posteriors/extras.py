"""What `--extras` names, done and kept: residual heads, the lost axle, sequential rounds, plots."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from nfc_gym.inference import checkpoint
from nfc_gym.inference.network import Network
from nfc_gym.inference.progress import Spoken
from nfc_gym.inference.train import TrainConfig
from posteriors import cases, plots, residuals
from posteriors.keep import Kept
from posteriors.methods import OURS, cell_name
from posteriors.sets import HALF, Sets, environment, prior_of

if TYPE_CHECKING:
    from posterior_table import Run

ROOM = 10 * 2**30  # of a GPU's memory that densities of one second round's proposals take


def _residuals(run: Run, robot: str, terrain: str, sets: Sets, what: str = "residuals") -> None:
    name, env, args = f"{robot}{terrain}_{what}", environment(robot, terrain), run.args
    maps = what == "residuals"
    struck = Sets(args.data, env, args.residual_windows, args.judges, HALF, maps, args.jobs, run.device)
    run.kept.once(name, lambda: residuals.heads(
        env, struck, prior_of(env), run.plan, run.folder(name), run.device, args.samples, args.few,
        Spoken())[1], trained_on=args.residual_windows)  # fmt: skip


def _axle(run: Run, robot: str, terrain: str, sets: Sets) -> None:
    if (robot, terrain) != ("Jackal", "Flat"):
        return
    for inputs in run.args.inputs:
        file = run.folder(cell_name(robot + terrain, OURS, inputs, run.args.seeds[0])) / "posterior.safetensors"
        if inputs != "map" and file.is_file():
            network = _opened(file, run)
            run.kept.once(f"{robot}{terrain}_{inputs}_axle", lambda n=network: cases.axle(
                n, environment(robot, terrain), run.args.axles, run.args.samples, run.args.jobs))  # fmt: skip


def _rounds(run: Run, robot: str, terrain: str, sets: Sets) -> None:
    """Truths side by side, a process each: a second round simulates and trains for one of them alone."""
    env, args, name = environment(robot, terrain), run.args, f"{robot}{terrain}_round"
    training = TrainConfig(epochs=args.epochs, batch=args.batch, rate=args.rate, mixed=False)
    folder = run.folder(f"{name}s_{args.round}")
    cases.before(env, prior_of(env), args.round, training, args.small, args.jobs, run.device, folder)
    at_once = min(args.truths, args.jobs or os.cpu_count() or 1)
    if run.device.type == "cuda":
        # Others may work on the same GPU: what is free now is what there is.
        at_once = max(1, min(at_once, torch.cuda.mem_get_info(run.device)[0] // ROOM))
    with ProcessPoolExecutor(at_once, get_context("spawn"), initializer=torch.set_num_threads, initargs=(1,)) as pool:
        asked = {
            pool.submit(
                _round, run.kept, f"{name}_{t}", env, t, args.round, training, args.ways, run.device, folder, run.ends
            )
            for t in range(args.truths)
        }
        found = [done for future in as_completed(asked) if (done := future.result())]
    if len(found) > 1:
        run.kept.keep(f"{name}s", cases.summed(found))


def _round(
    kept: Kept, name: str, env: str, truth: int, size: int, training: TrainConfig, ways: Sequence[str],
    device: torch.device, folder: Path, ends: float,
) -> dict[str, Any]:  # fmt: skip
    """One truth, unless time is up."""
    if time.monotonic() > ends:
        return {}
    return kept.once(
        name, lambda: cases.rounds(env, truth, size, training, ways, 1, device, folder), round=size, ways=list(ways)
    )


def _plots(run: Run, robot: str, terrain: str, sets: Sets) -> None:
    args, env = run.args, environment(robot, terrain)
    struck = Sets(args.data, env, args.residual_windows, args.judges, HALF, True, args.jobs, run.device)
    plots.draw(args.out, run.kept.out / "training", f"{robot}{terrain}", prior_of(env), sets, struck, run.device)


def _opened(file: Path, run: Run) -> Network:
    return checkpoint.load(file)[0].to(run.device)


EXTRAS: dict[str, Callable[..., None]] = {
    "residuals": _residuals,
    "motion": partial(_residuals, what="motion"),
    "axle": _axle,
    "rounds": _rounds,
    "plots": _plots,
}
