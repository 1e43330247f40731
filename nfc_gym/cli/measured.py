"""Commands of the measured loop: check, close-loop, predict, excite, demo."""

import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from nfc_gym.cli.outcome import BAD_INPUT, outcome, printable, say_written
from nfc_gym.core import InputError, kinds

if TYPE_CHECKING:
    from nfc_gym.measured.checks import Finding
    from nfc_gym.simulate.witness import Witness

MappingFile = Annotated[
    Path, typer.Argument(metavar="MAPPING.yaml", help="Names the model, its parameters and the logs.")
]
Seed = Annotated[int, typer.Option(min=0, max=2**32 - 2, help="The same inputs and seed give the same report.")]


class Mode(StrEnum):
    """What is predicted: motion from commands, forces from motion, or sensors from states and commands."""

    rollout = "rollout"
    inverse = "inverse"
    forward = "forward"


class Stage(StrEnum):
    """Which model predicts: as given, with calibrated parameters, or with the effects found as well."""

    nominal = "nominal"
    calibrated = "calibrated"
    extended = "extended"


def check(ctx: typer.Context, mapping: MappingFile) -> None:
    """Say in one place all that is wrong with a mapping file, its model and its logs; nothing is fitted or changed."""
    with outcome(ctx):
        from nfc_gym.measured.checks import check as find

        findings = find(mapping)
        _print_findings(findings)
        if any(f.severity == "error" for f in findings):
            raise typer.Exit(BAD_INPUT)


def _print_findings(findings: "list[Finding]") -> None:
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False, emoji=False, width=None if sys.stdout.isatty() else 140)
    if not findings:
        console.print("Nothing wrong found.")
        return
    colours = {"error": "bold red", "warning": "yellow", "note": "cyan"}
    table = Table("", "where", "what", "what to do", show_lines=True)
    for f in findings:
        cells = (Text(printable(text)) for text in (f.where, f.message, f.advice))
        table.add_row(Text(f.severity, colours[f.severity]), *cells)
    console.print(table)
    counts = [(s, sum(f.severity == s for f in findings)) for s in colours]
    console.print(", ".join(f"{n} {s}{'s' * (n != 1)}" for s, n in counts))


def close_loop(
    ctx: typer.Context,
    mapping: MappingFile,
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder for report.json, report.html, model.xml, effects.yaml.")
    ],
    seed: Seed = 0,
    jobs: Annotated[int, typer.Option(min=0, max=1024, help="Threads; 0 takes all cores.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what an earlier run left in DIR.")] = False,
    resume: Annotated[bool, typer.Option(help="Go on from the last finished stage of an interrupted run.")] = True,
    fold: Annotated[
        str | None, typer.Option(metavar="NAME", help="With `by: rotate`: only the fold that verifies NAME.")
    ] = None,
    posterior: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Start from a posterior of this machine, which `nfc-gym infer --out` wrote; or the structure head of "
            "`nfc-gym train --structure`, which says which effects to look at first.",
        ),
    ] = None,
    time_saved: Annotated[
        bool, typer.Option("--time-saved", help="Calibrate without the posterior too, to say what it saved.")
    ] = False,
) -> None:
    """Calibrate the model, find what it lacks, add it; report the error before and after on logs nobody fitted to."""
    with outcome(ctx, resumes=True):
        kinds.require_kind(out, kinds.REPORT)
        from nfc_gym.measured.loop import close_loop as run

        if time_saved and posterior is None:
            raise InputError("--time-saved says what a posterior saves: give --posterior FILE as well")
        belief, witness = consulted(posterior)
        run(
            mapping, out, seed=seed, jobs=jobs, overwrite=overwrite, resume=resume, fold=fold, posterior=belief,
            compare=time_saved, witness=witness, console=Console(),
        )  # fmt: skip


def consulted(posterior: Path | None) -> "tuple[Path | None, tuple[Witness, Path] | None]":
    """What of a posterior's file the loop starts from, and its structure head: a file may hold either, or both."""
    if posterior is None or posterior.suffix.lower() != ".safetensors" or not posterior.is_file():
        return posterior, None
    try:
        from nfc_gym.simulate.witness import Witness, heads
    except ImportError:
        return posterior, None  # who opens it says what is missing
    structure, window = heads(posterior)
    witness = (Witness(posterior), posterior) if structure else None
    return posterior if window or not structure else None, witness


def predict(
    ctx: typer.Context,
    mapping: MappingFile,
    out: Annotated[
        Path, typer.Option(metavar="FILE.npz", help="One array a log, by its name; a file that is there is replaced.")
    ],
    fit: Annotated[
        Path | None, typer.Option(metavar="DIR", help="What close-loop wrote; not needed for --stage nominal.")
    ] = None,
    mode: Annotated[Mode, typer.Option(help="rollout: motion; inverse: forces; forward: sensors.")] = Mode.rollout,
    stage: Annotated[Stage, typer.Option(help="Which model predicts.")] = Stage.extended,
    restart: Annotated[
        float | None,
        typer.Option(metavar="S", min=0, help="rollout: start anew from the measured state every S seconds."),
    ] = None,
) -> None:
    """Predict every log with the model as given, calibrated or extended.

    FILE.npz holds an array (rows, columns) for each log, in SI units. Its rows are those of the log, at the same times;
    where several clocks or a `shift` leave some out, those of `time` that all columns reach. Its columns follow the
    channels in the order of the mapping: for rollout all joint:NAME:pos and vel, body: and sensor: channels, each with
    its components, of orientations w, x, y, z; for inverse the force: channels; for forward the sensor: channels. A
    single column makes a vector (rows,).

    A rollout begins at the measured state of a log's first row (with `split: {by: time}`, of each part's), and with
    --restart anew every S seconds, with what the machine remembers of before. With `by: rotate` each log is predicted
    by the fit that did not see its group.

    Example: nfc-gym predict mapping.yaml --fit result --out predictions.npz
    """
    with outcome(ctx):
        if fit is None and stage is not Stage.nominal:
            raise InputError(
                f"--stage {stage.value} needs --fit DIR, the folder that close-loop wrote; or use --stage nominal"
            )
        if restart is not None and mode is not Mode.rollout:
            raise InputError(f"--restart goes with --mode rollout, not {mode.value}")
        if out.is_file():
            kinds.require_kind(out, kinds.ARRAYS)
            _require_no_log(mapping, out)
        from nfc_gym.measured.predict import predict as run

        found = run(mapping, fit, mode.value, stage.value, out, restart=restart)
        logs = f"{len(found)} log{'s' * (len(found) != 1)}"
        say_written(out, f"{mode.value} of {logs} by the {stage.value} model, an array each")


def _require_no_log(mapping: Path, out: Path) -> None:
    """Refuse to write over what was measured: by its content a log is no other kind than predictions or commands."""
    from nfc_gym.measured.mapping import load_mapping
    from nfc_gym.measured.splits import find_logs

    if out.resolve() in {source.path.resolve() for source in find_logs(load_mapping(mapping), mapping.parent)}:
        raise InputError(f"{out} is a log of {mapping}, and would be written over: choose another --out")


def excite(
    ctx: typer.Context,
    mapping: MappingFile,
    fit: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="What close-loop wrote: tell its claims from their rivals. Without it: see more."
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(metavar="S", help="Length of the proposed recording.")] = 10.0,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.csv", help="Commands; .json and .html go beside it. Default: excite.csv beside the mapping."
        ),
    ] = None,
    seed: Seed = 0,
    tries: Annotated[int, typer.Option(min=1, help="Motions to try in simulation, at most.")] = 250,
    budget: Annotated[
        float, typer.Option(metavar="S", min=1, help="Seconds after which the best so far is taken.")
    ] = 120,
    jobs: Annotated[int, typer.Option(min=0, help="Threads; 0 takes all cores.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier proposal.")] = False,
) -> None:
    """Propose what to record next: ten seconds of commands that tell apart what the present logs cannot.

    After close-loop, with --fit DIR: for each claim and its equivalents (or its worst mimic), the motion in which they
    would differ most once everything is refitted. Before it, without --fit: the motion in which every effect would show
    at the smallest size. Nothing of the machine is touched: the motion is found on the model, inside the actuators' and
    joints' ranges and within 1.2 times what the logs show.

    FILE.csv holds `time` and one `ctrl:` column an actuator, in the mapping's own units; FILE.json what is expected, in
    sigma, before and after; FILE.html a picture. A machine that only its controller keeps upright gets a feed-forward,
    to be added to the controller's commands. The new log goes into the mapping like any other; then close-loop again.

    Example: nfc-gym excite mapping.yaml --fit result --out next.csv
    """
    with outcome(ctx):
        if out is not None and overwrite and out.is_file():
            _require_no_log(mapping, out)
        from nfc_gym.measured.excite import excite as run

        run(
            mapping, fit, out, seconds=seconds, seed=seed, tries=tries, budget=budget, jobs=jobs, overwrite=overwrite,
            console=Console(),
        )  # fmt: skip


def demo(
    ctx: typer.Context,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the logs, the sealed envelope and the report.")],
    seed: Seed = 0,
) -> None:
    """Run the whole loop, blind, on a simulated stand-in machine with one hidden effect; then open the envelope."""
    with outcome(ctx):
        from nfc_gym.measured.demo import demo as run

        run(out, seed=seed, console=Console())
