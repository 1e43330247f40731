"""The command for after a mission: learn; torch is loaded only inside it."""

import sys
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from nfc_gym.cli.outcome import outcome
from nfc_gym.core import InputError, kinds

_MEASURES = {
    "false_alarms": "false alarms, share of normal windows",
    "finds_injected": "finds injected faults, AUROC",
    "gain": "gain over the prior, nats a parameter",
}


class Normal(StrEnum):
    """What of a mission is taken for normal motion: trajectories without an alarm, or all that did not alarm."""

    trajectories = "trajectories"
    windows = "windows"


def learn(
    ctx: typer.Context,
    mission: Annotated[
        Path, typer.Argument(metavar="RUN", help="What the mission gathered: the `folder` of Python's `adapt`.")
    ],
    posterior: Annotated[
        Path | None, typer.Option(metavar="FILE.safetensors", help="What `nfc-gym train` wrote; it stays as it is.")
    ] = None,
    detector: Annotated[
        Path | None,
        typer.Option(metavar="FILE.safetensors", help="What `detector_file.save` wrote; it stays as it is."),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="For what was learned. Default: RUN/learned.")] = None,
    normal: Annotated[
        Normal | None,
        typer.Option(
            help="The detector learns from trajectories without any alarm, which is the default; or from windows "
            "without one, for anomalies that come and go."
        ),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(help="Wanted share of false alarms. Default: what the detector was set for, or 0.05."),
    ] = None,
    beside: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Windows of `nfc-gym simulate` to mix in, so that nothing is forgotten."),
    ] = None,
    simulations: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=100, help="Windows simulated for the posterior along the mission's motion. Default: 4096."
        ),
    ] = None,
    effects: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE", min=0, max=1, help="Share of them with an effect that the model lacks. Default: 0.5."
        ),
    ] = None,
    epochs: Annotated[int, typer.Option(min=1, help="Passes over the windows, at most.")] = 20,
    environment: Annotated[
        str | None, typer.Option(metavar="ID", help="Of the simulator. Default: the one that RUN names.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the shares, the simulations and the noise.")] = 0,
    jobs: Annotated[int, typer.Option(min=0, max=1024, help="Processes of simulation; 0 takes all cores.")] = 0,
    device: Annotated[str, typer.Option(help="Of training: auto, cpu or cuda.")] = "auto",
) -> None:
    """Train a posterior and an anomaly detector further on what a mission gathered, and say what that changed.

    The posterior learns from the mission's motion, simulated again with psi drawn from the prior: what is trained on
    its own beliefs grows surer of them, right or wrong. The detector learns from what was normal, and its threshold is
    set anew. Both are judged on trajectories that nothing was learned from; where these are too few nothing changes,
    and the table says what it takes.

    DIR holds posterior.safetensors and detector.safetensors, where they changed, and learned.json. Interrupted, even
    killed, the same command goes on; after the end it says again what it found.

    Example: nfc-gym learn runs/axle --posterior jackal.safetensors --detector detector.safetensors
    """
    with outcome(ctx, resumes=True):
        if posterior is None and detector is None:
            raise InputError("there is nothing to train: give --posterior FILE, --detector FILE or both")
        _require_used("posterior", posterior is not None, simulations=simulations, effects=effects)
        _require_used("detector", detector is not None, rate=rate, normal=normal)
        folder = mission / "learned" if out is None else out
        kinds.require_kind(folder, kinds.LEARNED)
        kinds.require_kind(folder / "posterior.safetensors", kinds.POSTERIOR)
        kinds.require_kind(folder / "detector.safetensors", kinds.DETECTOR)
        from dataclasses import replace

        from nfc_gym.adaptation import LearnConfig, learn_from_mission
        from nfc_gym.adaptation.normal import quiet_trajectories, quiet_windows
        from nfc_gym.inference.data import StoredWindows
        from nfc_gym.inference.windows import Windows

        given = {"rate": rate, "simulations": simulations, "effects": effects}
        config = LearnConfig(seed=seed, **{k: v for k, v in given.items() if v is not None})
        learned = learn_from_mission(
            mission, posterior=posterior, detector=detector, environment=environment,
            normal=quiet_windows if normal is Normal.windows else quiet_trajectories,
            beside=None if beside is None else StoredWindows(Windows(beside)),
            config=replace(config, training=replace(config.training, epochs=epochs)),
            folder=folder, jobs=jobs, device=device, console=Console(stderr=True),
        )  # fmt: skip
        _print_learned(learned.report, folder)


def _require_used(part: str, there: bool, **options: object) -> None:
    """Refuse options of a part that is left out: they would do nothing."""
    for name, value in options.items():
        if value is not None and not there:
            raise InputError(f"--{name} {value} is for the {part}: give --{part} FILE too, or leave it out")


def _print_learned(report: Mapping[str, Any], folder: Path) -> None:
    """What `learned.json` says: a row for each figure, before and after; else why nothing changed."""
    from rich.table import Table

    console = Console(highlight=False, emoji=False, width=None if sys.stdout.isatty() else 140)
    table = Table("", "judged by", "before", "after")
    for what in ("detector", "posterior"):
        found = report.get(what, {})
        for name, words in _MEASURES.items():
            if name in found:
                table.add_row(what, words, *(_figure(found[name][k]) for k in ("before", "after")))
    if table.row_count:
        console.print(table)
    for what in ("detector", "posterior"):
        if what in report:
            found = report[what]
            said = "changed" if found["changed"] else f"not changed: {found['why']}"
            console.print(f"{what}: {said}", markup=False, emoji=False, soft_wrap=True)
    console.print(f"all of it is in {folder}", markup=False, emoji=False, soft_wrap=True)


def _figure(value: list[float]) -> str:
    mean, error = value
    return f"{mean:.4g} (standard error {error:.2g})"
