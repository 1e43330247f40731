"""What `--extras` names, done and kept: residual heads, the lost axle, sequential rounds, plots."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from nfc_gym.inference import checkpoint
from nfc_gym.inference.network import Network
from nfc_gym.inference.progress import Spoken
from nfc_gym.inference.train import TrainConfig
from posteriors import cases, plots, residuals
from posteriors.methods import OURS, cell_name
from posteriors.sets import HALF, Sets, environment, prior_of

if TYPE_CHECKING:
    from posterior_table import Run


def _residuals(run: Run, robot: str, terrain: str, sets: Sets) -> None:
    name, env, args = f"{robot}{terrain}_residuals", environment(robot, terrain), run.args
    struck = Sets(args.data, env, args.residual_windows, args.judges, HALF, True, args.jobs, run.device)
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
    env, args, found = environment(robot, terrain), run.args, []
    training = TrainConfig(epochs=args.epochs, batch=args.batch, rate=args.rate)
    for truth in range(args.truths):
        if run.over:
            break
        found.append(run.kept.once(f"{robot}{terrain}_round_{truth}", lambda t=truth: cases.rounds(
            env, prior_of(env), t, args.round, training, args.small, args.jobs, run.device)))  # fmt: skip
    if len(found) > 1:
        run.kept.keep(f"{robot}{terrain}_rounds", cases.summed(found))


def _plots(run: Run, robot: str, terrain: str, sets: Sets) -> None:
    args, env = run.args, environment(robot, terrain)
    struck = Sets(args.data, env, args.residual_windows, args.judges, HALF, True, args.jobs, run.device)
    plots.draw(args.out, run.kept.out / "training", f"{robot}{terrain}", prior_of(env), sets, struck, run.device)


def _opened(file: Path, run: Run) -> Network:
    return checkpoint.load(file)[0].to(run.device)


EXTRAS: dict[str, Callable[..., None]] = {
    "residuals": _residuals, "axle": _axle, "rounds": _rounds, "plots": _plots,
}  # fmt: skip
