"""`nfc-gym`: the commands; what is heavy is imported inside them.

Exit codes: 0 finished, whatever the verdict; 2 bad input; 3 interrupted, the same command resumes; 1 a fault of ours.
"""

import errno
import io
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer
from rich.console import Console

from nfc_gym import __version__
from nfc_gym.adaptation import commands as policies
from nfc_gym.core import InputError, NfcError

if TYPE_CHECKING:
    from nfc_gym.inference.posterior import Window
    from nfc_gym.measured.checks import Finding
    from nfc_gym.simulate.witness import Witness

FAULT, BAD_INPUT, INTERRUPTED = 1, 2, 3

# What the operating system may refuse, and what the user can do about it.
_REFUSALS = {
    errno.ENOSPC: "the disk is full: free some space and run the same command again",
    errno.EDQUOT: "your disk quota is used up: free some space and run the same command again",
    errno.EACCES: "permission denied: choose a place that you may write to, or change the permissions",
    errno.EPERM: "not permitted: choose a place that you may write to, or change the permissions",
    errno.ENAMETOOLONG: "a name is too long for this file system: choose a shorter one",
    errno.EROFS: "the file system is read-only: choose another --out",
}

app = typer.Typer(
    help="Find what a MuJoCo model lacks, from logs of the real machine, and put it there.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


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


MappingFile = Annotated[
    Path, typer.Argument(metavar="MAPPING.yaml", help="Names the model, its parameters and the logs.")
]
Seed = Annotated[int, typer.Option(min=0, max=2**32 - 2, help="The same inputs and seed give the same report.")]


def _say_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _options(
    ctx: typer.Context,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[bool, typer.Option("--version", callback=_say_version, is_eager=True, help="Say it.")] = False,
) -> None:
    ctx.obj = debug


@app.command()
def check(ctx: typer.Context, mapping: MappingFile) -> None:
    """Say in one place all that is wrong with a mapping file, its model and its logs; nothing is fitted or changed."""
    with _outcome(ctx):
        from nfc_gym.measured.checks import check as find

        findings = find(mapping)
        _print_findings(findings)
        if any(f.severity == "error" for f in findings):
            raise typer.Exit(BAD_INPUT)


@app.command("close-loop")
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
            help="Start from a posterior of this machine, which `nfc-gym infer --out` wrote; one that was trained with "
            "--structure says which effects to look at first, given a window or not.",
        ),
    ] = None,
    time_saved: Annotated[
        bool, typer.Option("--time-saved", help="Calibrate without the posterior too, to say what it saved.")
    ] = False,
) -> None:
    """Calibrate the model, find what it lacks, add it; report the error before and after on logs nobody fitted to."""
    with _outcome(ctx, resumes=True):
        from nfc_gym.measured.loop import close_loop as run

        belief, witness = _consulted(posterior)
        run(
            mapping, out, seed=seed, jobs=jobs, overwrite=overwrite, resume=resume, fold=fold, posterior=belief,
            compare=time_saved, witness=witness, console=Console(),
        )  # fmt: skip


def _consulted(posterior: Path | None) -> "tuple[Path | None, tuple[Witness, Path] | None]":
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


@app.command()
def predict(
    ctx: typer.Context,
    mapping: MappingFile,
    out: Annotated[Path, typer.Option(metavar="FILE.npz", help="One array a log.")],
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
    """Predict every log with the model as given, calibrated or extended."""
    with _outcome(ctx):
        if fit is None and stage is not Stage.nominal:
            raise InputError(
                f"--stage {stage.value} needs --fit DIR, the folder that close-loop wrote; or use --stage nominal"
            )
        if restart is not None and mode is not Mode.rollout:
            raise InputError(f"--restart goes with --mode rollout, not {mode.value}")
        from nfc_gym.measured.predict import predict as run

        run(mapping, fit, mode.value, stage.value, out, restart=restart)


@app.command()
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
        typer.Option(metavar="FILE.csv", help="Commands; .json and .html go beside it. Default: excite.csv."),
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
    with _outcome(ctx):
        from nfc_gym.measured.excite import excite as run

        run(
            mapping, fit, out, seconds=seconds, seed=seed, tries=tries, budget=budget, jobs=jobs, overwrite=overwrite,
            console=Console(),
        )  # fmt: skip


@app.command()
def simulate(
    ctx: typer.Context,
    environment: Annotated[str, typer.Argument(metavar="ID", help="For instance nfc_gym/JackalFlat-v0.")],
    windows: Annotated[int, typer.Option(metavar="N", min=1, help="How many windows.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for manifest.json and the shards.")],
    seed: Annotated[int, typer.Option(min=0, help="The same arguments and seed give the same bits.")] = 0,
    jobs: Annotated[int, typer.Option(min=0, max=1024, help="Processes; 0 takes all cores.")] = 0,
    effects: Annotated[
        float, typer.Option(metavar="SHARE", min=0, max=1, help="Share of windows with an effect that the model lacks.")
    ] = 0.5,
    proposal: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw psi from this (.npz of psi, or a posterior) and not from the prior."),
    ] = None,
    policy: Annotated[
        str | None,
        typer.Option(
            metavar="POLICY",
            help="Moves some windows: .safetensors of `nfc-gym pretrain`, an id (its packaged policy), TorchScript "
            "(.pt), or .npz of a perceptron.",
        ),
    ] = None,
    policy_share: Annotated[
        float, typer.Option(metavar="SHARE", min=0, max=1, help="Share of windows that it moves.")
    ] = 0.5,
    motor: Annotated[
        float,
        typer.Option("--motor-noise", metavar="SD", min=0, max=1, help="Of motors, a share of the actions' range."),
    ] = 0.02,
    maps: Annotated[bool, typer.Option("--maps", help="Keep the elevation maps too, 64 KB a window.")] = False,
    ray: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Use a Ray cluster: its address, auto, or local.")
    ] = None,
) -> None:
    """Make a training set: windows of simulated motion with the psi, the effect and the terrain that made each.

    Each window is simulated under its own psi, drawn from the prior, on its own ground, excited richly or moved by a
    policy, and half of the windows have an effect that the model lacks (friction in a joint, a payload, slip ...): what
    that adds to a control step is the residual delta_s to be learned. Windows that come apart are drawn anew.

    The same arguments and seed give the same bits with any --jobs. Interrupted, even killed, the same command goes on:
    finished shards stay. DIR holds manifest.json, which says what every array is, and shard_00000.safetensors, ...;
    nfc_gym.inference.windows.Windows(DIR) reads them. A sequential round draws psi from --proposal.

    Example: nfc-gym simulate nfc_gym/JackalFlat-v0 --windows 100000 --out windows/jackal
    """
    with _outcome(ctx, resumes=True):
        from nfc_gym.simulate import simulate as run

        mover = policy
        if policy is not None and Path(policy).suffix.lower() in ("", ".safetensors"):
            from nfc_gym.adaptation import load_policy

            mover = load_policy(policy).perceptron()  # plain arrays: any process can be sent them
        run(
            environment, windows, out, seed=seed, jobs=jobs, effects=effects, proposal=proposal, policy=mover,
            policy_share=policy_share, motor=motor, ray=ray, console=Console(),
        )  # fmt: skip
        if maps:
            from nfc_gym.simulate.maps import keep_maps

            keep_maps(out, jobs, Console())


@app.command()
def train(
    ctx: typer.Context,
    windows: Annotated[Path, typer.Argument(metavar="DIR", help="What `nfc-gym simulate` wrote.")],
    out: Annotated[Path, typer.Option(metavar="FILE.safetensors", help="The posterior.")],
    encoder: Annotated[str, typer.Option(help="Of the motion: tcn, nn, qmc-rff, qmc-fks, none.")] = "tcn",
    density: Annotated[str, typer.Option(help="Of psi: score (diffusion), mixture, flow (splines).")] = "score",
    delta_s: Annotated[bool, typer.Option(help="Infer the residual dynamics too.")] = True,
    maps: Annotated[
        bool, typer.Option("--maps", help="See the elevation map; needs windows simulated with --maps.")
    ] = False,
    structure: Annotated[
        bool,
        typer.Option("--structure", help="In place of a posterior: a head for close-loop, which family it lacks."),
    ] = False,
    noise: Annotated[
        float, typer.Option(metavar="FACTOR", min=0, help="Times the sensor noise that the windows' manifest assumes.")
    ] = 1.0,
    epochs: Annotated[int, typer.Option(min=1, help="Passes over the windows, at most.")] = 100,
    batch: Annotated[int, typer.Option(min=1, help="Windows a step.")] = 256,
    seed: Annotated[int, typer.Option(min=0, help="Of the first weights, the order and the noise.")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda; auto is a GPU where there is one.")] = "auto",
) -> None:
    """Train a posterior: from a window of motion to a distribution over psi (and delta_s) that could have made it.

    Done once a robot; `nfc-gym infer` then takes milliseconds a window. A twentieth of the windows is held out, and the
    weights kept are those of the epoch that did best on it. Interrupted, even killed, the same command goes on: the
    state lies in FILE.safetensors.training, which may be deleted at the end.

    What the motion does not show comes back as wide as the prior, however long one trains: simulate motion like the one
    that you will log.

    With --structure the file holds a structure head instead: shown motion and what a calibrated model without effects
    misses of it, it says which family of effects is at work; `nfc-gym close-loop --posterior` then looks there first.

    Example: nfc-gym train windows/jackal --out jackal.safetensors
    """
    with _outcome(ctx, resumes=True):
        from nfc_gym.core import MissingExtra
        from nfc_gym.inference.windows import Manifest
        from nfc_gym.simulate.machine import Machine

        try:
            from nfc_gym.inference import jobs
        except ImportError as e:
            raise MissingExtra(f"{e}: pip install 'nfc_gym[inference]'") from None
        from nfc_gym.inference.config import NetworkConfig
        from nfc_gym.inference.progress import Spoken
        from nfc_gym.inference.space import PriorBox
        from nfc_gym.inference.train import TrainConfig

        machine = Machine(Manifest.read(windows).environment)
        prior = PriorBox.of(machine.space, machine.kind.name)
        config = NetworkConfig(
            encoder=encoder, density=density, summaries=True, linear=True, elevation=maps, delta_s=delta_s
        )
        training, how = TrainConfig(epochs=epochs, batch=batch, seed=seed), {"report": Spoken(), "noise": noise}
        if structure:
            from nfc_gym.simulate.teach import train_structure

            done = train_structure(windows, out, training, device=jobs.device_of(device), **how)
        else:
            done = jobs.train_posterior(windows, prior, out, config, training, device=device, **how)
        if done.best:
            said = f"held-out loss {done.start:.4f} before, {done.held_out[done.best - 1]:.4f} in epoch {done.best}"
        else:
            said = "nothing that was learned held on the windows held out: simulate more of them"
        typer.echo(f"{out}: {said} ({done.seconds:.0f} s)")


@app.command()
def infer(
    ctx: typer.Context,
    posterior: Annotated[Path, typer.Argument(metavar="FILE.safetensors", help="What `nfc-gym train` wrote.")],
    window: Annotated[
        Path,
        typer.Argument(
            metavar="WINDOW", help=".npz with `states` (n + 1, s) and `actions` (n, a); or a mapping file of logs."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help=".npz: the draws; .safetensors: the posterior given this window."),
    ] = None,
    samples: Annotated[int, typer.Option(min=1, help="Draws.")] = 1000,
    seed: Annotated[int, typer.Option(min=0, help="Of the draws.")] = 0,
    log: Annotated[str | None, typer.Option(metavar="NAME", help="Of a mapping's logs; default the first.")] = None,
    until: Annotated[float | None, typer.Option(metavar="SECONDS", help="Where the window ends in that log.")] = None,
) -> None:
    """Say what psi could have made a window of motion, and draw from that posterior.

    `states` are `obs["proprio"]` of the robot at each control step and `actions` what was commanded, in [-1, 1], both
    in the order of the training set's manifest; with a posterior that sees maps, `elevation` (128, 128) too. A window
    longer than the training set's counts from its end. The table gives each parameter's median and 90 % interval; one
    that the window does not show stays as wide as the prior, and is marked.

    A mapping file (or the folder that RecordLog wrote) names logs instead; what the robot would have observed is then
    made of their channels, for robots that feel no forces: Jackal, Quadcopter, Quadruped.

    Either kind of --out goes into RandomizePsi, into `nfc-gym simulate --proposal` and into `nfc-gym close-loop
    --posterior`.

    Example: nfc-gym infer jackal.safetensors window.npz --out psi.npz
    """
    with _outcome(ctx):
        from rich.table import Table

        from nfc_gym.core import MissingExtra

        try:
            from nfc_gym.inference import jobs
        except ImportError as e:
            raise MissingExtra(f"{e}: pip install 'nfc_gym[inference]'") from None

        mapped = window.is_dir() or window.suffix in (".yaml", ".yml")
        seen = _window(posterior, window, log, until) if mapped else window
        _, found = jobs.infer(posterior, seen, samples=samples, seed=seed, out=out)
        table = Table("parameter", "unit", "median", "90 % interval", "width over the prior's")
        for each in found:
            note = "  not shown" if each.width >= jobs.AS_WIDE else ""
            interval = f"{each.low:.4g} to {each.high:.4g}"
            table.add_row(each.name, each.unit, f"{each.median:.4g}", interval, f"{each.width:.2f}{note}")
        Console(highlight=False, width=None if sys.stdout.isatty() else 140).print(table)


def _window(posterior: Path, mapping: Path, log: str | None, until: float | None) -> "Window":
    """The window of motion that a posterior wants, from a log of a mapping."""
    from nfc_gym.inference.checkpoint import load as read
    from nfc_gym.inference.posterior import Window
    from nfc_gym.measured.dataset import load
    from nfc_gym.measured.states import estimate_states
    from nfc_gym.simulate.machine import Machine
    from nfc_gym.simulate.observed import commands, observed

    environment = read(posterior)[2].get("environment")
    if environment is None:
        raise InputError(f"{posterior}: does not say of which environment it is: give the window as an .npz")
    logs = {each.name: each for each in load(mapping / "mapping.yaml" if mapping.is_dir() else mapping).logs}
    if log is not None and log not in logs:
        raise InputError(f"{mapping}: no log {log!r}; there are: {', '.join(logs)}")
    chosen = logs[log] if log is not None else next(iter(logs.values()))
    machine = Machine(environment)
    states = estimate_states(machine.model, chosen, raw=True)
    end = len(chosen) if until is None else int((chosen.time <= until + 1e-9).sum())
    parts = (chosen.time, states.qpos, states.qvel, commands(machine, chosen.controls))
    return Window(*observed(machine, *(part[:end] for part in parts)))


@app.command()
def demo(
    ctx: typer.Context,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the logs, the sealed envelope and the report.")],
    seed: Seed = 0,
) -> None:
    """Run the whole loop, blind, on a simulated stand-in machine with one hidden effect; then open the envelope."""
    with _outcome(ctx):
        from nfc_gym.measured.demo import demo as run

        run(out, seed=seed, console=Console())


@contextmanager
def _outcome(ctx: typer.Context, resumes: bool = False) -> Iterator[None]:
    """Turn whatever a command raises into one clear message on stderr and the exit code that goes with it."""
    try:
        with _terminable():
            yield
    except typer.Exit:
        raise
    except KeyboardInterrupt:
        again = "goes on from the last finished stage" if resumes else "starts over"
        _fail(ctx, INTERRUPTED, f"interrupted; the same command {again}")
    except NfcError as e:
        _fail(ctx, BAD_INPUT, str(e))
    except OSError as e:
        refusal = _REFUSALS.get(e.errno or 0) or (_REFUSALS[errno.ENOSPC] if "No space left" in str(e) else None)
        if refusal is None:
            _fault(ctx, e)
        _fail(ctx, BAD_INPUT, f"{e.filename}: {refusal}" if e.filename else refusal)
    except Exception as e:
        _fault(ctx, e)


@contextmanager
def _terminable() -> Iterator[None]:
    """A request to terminate (SIGTERM, as job schedulers send it) interrupts like Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():  # only there may handlers be set
        yield
        return

    def interrupt(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _fail(ctx: typer.Context, code: int, message: str) -> NoReturn:
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    if ctx.obj:
        console.print(traceback.format_exc(), markup=False)
    console.print(f"nfc-gym {ctx.info_name}: {_printable(message)}", markup=False)
    raise typer.Exit(code)


def _printable(text: str) -> str:
    """File names may hold bytes that are no text: these are shown as escapes."""
    return text.encode(errors="backslashreplace").decode()


def _fault(ctx: typer.Context, error: Exception) -> NoReturn:
    hint = "" if ctx.obj else "; the same command with --debug shows where"
    what = " ".join(f"{type(error).__name__}: {error}".split())
    _fail(
        ctx,
        FAULT,
        f"a fault of nfc-gym, not of yours: {what}{hint}. Please report it with that output and the mapping.",
    )


def _print_findings(findings: "list[Finding]") -> None:
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False, width=None if sys.stdout.isatty() else 140)
    if not findings:
        console.print("Nothing wrong found.")
        return
    colours = {"error": "bold red", "warning": "yellow", "note": "cyan"}
    table = Table("", "where", "what", "what to do", show_lines=True)
    for f in findings:
        cells = (Text(_printable(text)) for text in (f.where, f.message, f.advice))
        table.add_row(Text(f.severity, colours[f.severity]), *cells)
    console.print(table)
    counts = [(s, sum(f.severity == s for f in findings)) for s in colours]
    console.print(", ".join(f"{n} {s}{'s' * (n != 1)}" for s, n in counts))


policies.register(app, _outcome)


def main() -> None:
    """The entry point of `nfc-gym`; `--debug` may stand anywhere on the line."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # what a terminal cannot show is no reason to fail
    args = [a for a in sys.argv[1:] if a != "--debug"]
    app(["--debug", *args] if len(args) < len(sys.argv) - 1 else args, prog_name="nfc-gym")
