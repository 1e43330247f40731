"""Commands of neural posteriors: simulate, train, infer; torch is loaded only inside them."""

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from nfc_gym.cli.outcome import outcome, say_written
from nfc_gym.cli.policies import Environment
from nfc_gym.core import InputError, Sampler, kinds, load_source
from nfc_gym.core.files import require_writable

if TYPE_CHECKING:
    from rich.table import Table

    from nfc_gym.inference.around import Height
    from nfc_gym.inference.jobs import Told
    from nfc_gym.inference.posterior import Window
    from nfc_gym.inference.train import Outcome
    from nfc_gym.simulate.machine import Machine
    from nfc_gym.simulate.policy import Perceptron


def simulate(
    ctx: typer.Context,
    environment: Environment,
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
    that adds to a control step is the residual delta_s to be learned. Windows that come apart are drawn anew; psi that
    --proposal drew stay.

    The same arguments and seed give the same bits with any --jobs. Interrupted, even killed, the same command goes on:
    finished shards stay. DIR holds manifest.json, which says what every array is, and shard_00000.safetensors, ...;
    nfc_gym.inference.windows.Windows(DIR) reads them. A sequential round draws psi from --proposal.

    Example: nfc-gym simulate JackalFlat --windows 100000 --out windows/jackal
    """
    with outcome(ctx, resumes=True):
        _require_used(policy is not None, "for --policy: give --policy too", **_asked(ctx, "policy_share"))
        kinds.require_kind(out, kinds.WINDOWS)
        from nfc_gym.simulate import simulate as run

        source = None if proposal is None else belief_of(proposal, environment, "--proposal")
        run(
            environment, windows, out, seed=seed, jobs=jobs, effects=effects, proposal=source, policy=_mover(policy),
            policy_share=policy_share, motor=motor, ray=ray, console=Console(),
        )  # fmt: skip
        if maps:
            from nfc_gym.simulate.maps import keep_maps

            keep_maps(out, jobs, Console())


def _mover(policy: str | None) -> "Perceptron | str | None":
    """What moves windows; policies of this package are plain arrays, since any process can be sent those."""
    if policy is None or Path(policy).suffix.lower() not in ("", ".safetensors"):
        return policy
    from nfc_gym.adaptation import load_policy

    return load_policy(policy).perceptron()


def belief_of(file: Path, environment: str, option: str) -> Sampler:
    """What psi is drawn from; of a posterior it is said here what is wrong with it, since here its file is known."""
    source = load_source(file)
    if file.suffix.lower() != ".safetensors":
        return source
    from nfc_gym.inference.normal import NormalPosterior
    from nfc_gym.inference.posterior import NeuralPosterior
    from nfc_gym.simulate.machine import Machine

    if isinstance(source, NeuralPosterior | NormalPosterior):
        machine, robot = Machine(environment), source.prior.robot
        if robot != machine.kind.name:
            raise InputError(
                f"{option} {file}: a posterior of the robot {robot!r}, and {machine.environment} is of "
                f"{machine.kind.name!r}: choose one of that robot"
            )
        if isinstance(source, NeuralPosterior) and source.kept is None:
            raise InputError(
                f"{option} {file}: this posterior was given no window: give what "
                f"`nfc-gym infer {file} window.npz --out given.safetensors` writes"
            )
    return source


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
    delta_e: Annotated[
        bool,
        typer.Option("--delta-e", help="Infer the residual terrain too; needs --maps and the density score."),
    ] = False,
    families: Annotated[
        bool, typer.Option("--families", help="Say too how likely each family of effects is at work.")
    ] = False,
    structure: Annotated[
        bool,
        typer.Option("--structure", help="In place of a posterior: a head for close-loop, which family it lacks."),
    ] = False,
    mirror: Annotated[
        bool,
        typer.Option(
            help="Show half of the windows in each mirror of the robot, as if they were more; not with --maps."
        ),
    ] = True,
    noise: Annotated[
        float, typer.Option(metavar="FACTOR", min=0, help="Times the sensor noise that the windows' manifest assumes.")
    ] = 1.0,
    epochs: Annotated[
        int | None, typer.Option(min=1, help="Passes over the windows, at most; default 100, 4 with --structure.")
    ] = None,
    batch: Annotated[int, typer.Option(min=1, help="Windows a step.")] = 256,
    seed: Annotated[int, typer.Option(min=0, help="Of the first weights, the order and the noise.")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda; auto is a GPU where there is one.")] = "auto",
) -> None:
    """Train a posterior: from a window of motion to a distribution over psi (and delta_s, delta_e) that could have made
    it.

    Done once a robot; `nfc-gym infer` then takes milliseconds a window. A twentieth of the windows is held out, and the
    weights kept are those of the epoch that did best on it. What a window tells of psi, in nats a parameter, is printed
    at the end as other windows have it, which neither trained nor chose the epoch: a twentieth of all, 20 at least (of
    fewer than 100 a fifth) and 256 at most, drawn by --seed. Interrupted, even killed, the same command goes on: the
    state lies in FILE.safetensors.training, which may be deleted at the end.

    What the motion does not show comes back as wide as the prior, however long one trains: simulate motion like the one
    that you will log.

    With --maps --delta-e one network infers psi, delta_s and delta_e jointly, and with --families it has all its heads.
    delta_e is what the ground around the robot is beyond the map that it perceives, 128 x 128 cells: ResidualTerrain,
    Hallucinate and `nfc-gym adapt` lay it where the robot starts. Train it on windows of rough ground, on a GPU: on
    flat ground it is the camera's error alone.

    With --structure the file holds a structure head instead: shown motion and what a calibrated model without effects
    misses of it, it says which family of effects is at work; `nfc-gym close-loop --posterior` then looks there first.

    Example: nfc-gym train windows/jackal --out jackal.safetensors
    """
    with outcome(ctx, resumes=True):
        of_posteriors = _asked(ctx, "encoder", "density", "delta_s", "maps", "delta_e", "families")
        _require_used(not structure, "for a posterior: give it without --structure", **of_posteriors)
        terrain = _asked(ctx, "delta_e")
        _require_used(maps, "what the ground is beyond the map that is seen: give --maps too", **terrain)
        _require_used(density == "score", f"inferred by --density score, not {density}: leave that out", **terrain)
        kinds.require_kind(out, kinds.STRUCTURE if structure else kinds.POSTERIOR)
        require_writable(out.absolute().parent)
        jobs = learning()
        from nfc_gym.inference.config import NetworkConfig
        from nfc_gym.inference.progress import Spoken
        from nfc_gym.inference.reflection import Reflection
        from nfc_gym.inference.space import PriorBox
        from nfc_gym.inference.train import TrainConfig
        from nfc_gym.simulate.teach import TRAINING, train_structure

        training = TRAINING if structure else TrainConfig()
        training = replace(training, epochs=epochs or training.epochs, batch=batch, seed=seed)
        how = {"report": Spoken(), "noise": noise}
        machine = _machine(windows)
        if structure:
            done = train_structure(windows, out, training, device=jobs.device_of(device), mirror=mirror, **how)
        else:
            config = NetworkConfig(
                encoder=encoder, density=density, summaries=True, linear=True, elevation=maps, delta_s=delta_s,
                delta_e=delta_e, families=_families(windows) if families else (),
            )  # fmt: skip
            prior = PriorBox.of(machine.space, machine.kind.name)
            image = Reflection(machine.mirrors) if mirror else None
            done = jobs.train_posterior(windows, prior, out, config, training, device=device, mirror=image, **how)
        say_written(out, f"{learned(done)} ({done.seconds:.0f} s){'' if structure else _told(out)}")


def learning() -> ModuleType:
    """`inference.jobs`, which needs an extra."""
    from nfc_gym.core import MissingExtra

    try:
        from nfc_gym.inference import jobs
    except ImportError as e:
        raise MissingExtra(f"{e}: pip install 'nfc_gym[inference]'") from None
    return jobs


def _machine(windows: Path) -> "Machine":
    """The robot that windows are of."""
    from nfc_gym.inference.windows import Manifest
    from nfc_gym.simulate.machine import Machine

    return Machine(Manifest.read(windows).environment)


def _families(windows: Path) -> tuple[str, ...]:
    """Of effects that windows have."""
    from nfc_gym.inference.windows import Manifest

    return tuple(Manifest.read(windows).families)


def learned(done: "Outcome") -> str:
    """What training came to, by the windows that chose the epoch."""
    if not done.best:
        return "nothing that was learned held on the windows held out: simulate more of them"
    return f"held-out loss {done.start:.4f} before, {done.held_out[done.best - 1]:.4f} in epoch {done.best}"


def _told(posterior: Path) -> str:
    """What a window tells of psi, by the notes of a posterior that was just trained."""
    from nfc_gym.inference import checkpoint

    told = checkpoint.load(posterior)[2]["told"]
    mean, error = told["mean"], told["error"]
    if told["windows"] < 2:  # whose spread is no standard error
        return "; too few windows to keep some by which to judge what a window tells of psi: simulate more of them"
    more = "" if mean > 2 * error else ", no more than the prior: simulate more windows, or motion that shows it"
    return (
        f"; of psi a window tells {mean:.3f} nats a parameter (standard error {error:.3f}, {told['windows']} windows "
        f"that neither trained nor chose the epoch){more}"
    )


def infer(
    ctx: typer.Context,
    posterior: Annotated[
        Path,
        typer.Argument(
            metavar="FILE.safetensors|ID", help="What `nfc-gym train` wrote; with --refine an environment will do."
        ),
    ],
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
    samples: Annotated[
        int | None, typer.Option(min=1, help="Draws; default 1000, with --delta-e 32.", show_default=False)
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the draws.")] = 0,
    delta_e: Annotated[
        bool,
        typer.Option("--delta-e", help="Draw the residual terrain too, jointly: a second a draw without a GPU."),
    ] = False,
    log: Annotated[str | None, typer.Option(metavar="NAME", help="Of a mapping's logs; default the first.")] = None,
    until: Annotated[float | None, typer.Option(metavar="SECONDS", help="Where the window ends in that log.")] = None,
    refine: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="Ask the simulator: N simulations of these commands at most, 10000 are plenty."
        ),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=0, help="For --refine: processes that simulate; default 0, all cores.")
    ] = None,
) -> None:
    """Say what psi could have made a window of motion, and draw from that posterior.

    `states` are `obs["proprio"]` of the robot at each control step and `actions` what was commanded, in [-1, 1], both
    in the order of the training set's manifest; with a posterior that sees maps, `elevation` (128, 128) too. A window
    longer than the training set's counts from its end. The table gives each parameter's median and 90 % interval; one
    that the window does not show stays as wide as the prior, and is marked.

    A mapping file (or the folder that RecordLog wrote) names logs instead; what the robot would have observed is then
    made of their channels, for robots that feel no forces: Jackal, Quadcopter, Quadruped.

    A posterior of any window reads each a little coarsely. --refine N simulates this window's own commands again and
    again, in rounds that close in on the psi which do what was observed: 10 to 90 s of a core, on a plane, of psi
    alone, and sharper on all robots but the Jackal. It needs no trained posterior: give the environment's id, and it
    begins with the prior.

    A posterior trained with --delta-e infers the residual terrain too. --delta-e draws it, prints what it adds to the
    perceived ground at a few places around the robot, and keeps it in the .npz beside psi; ResidualTerrain and
    Hallucinate lay it where the robot starts. The posterior in a .safetensors holds it with and without this option.

    Either kind of --out goes into RandomizePsi, into `nfc-gym simulate --proposal` and into `nfc-gym close-loop
    --posterior`.

    Examples: nfc-gym infer jackal.safetensors window.npz --out psi.npz, nfc-gym infer JackalFlat window.npz --refine
    10000 --out today.safetensors
    """
    with outcome(ctx):
        mapped = window.is_dir() or window.suffix in (".yaml", ".yml")
        _require_used(mapped, f"of a mapping's logs, and {window} is no mapping file", log=log, until=until)
        _require_used(refine is not None, "for --refine: give --refine N too", jobs=jobs)
        _require_used(refine is None, "not refined, which is of psi alone", **_asked(ctx, "delta_e"))
        samples = samples or (32 if delta_e else 1000)
        inference = learning()
        from nfc_gym.inference.progress import Spoken

        trained = refine is None or posterior.suffix.lower() == ".safetensors"
        environment = _environment(posterior) if trained and mapped else "" if trained else str(posterior)
        seen = _window(environment, window, log, until) if mapped else window
        anew, report = None, Spoken()
        if refine is not None:
            from nfc_gym.simulate.refined import refined

            anew = partial(
                refined, environment=environment, simulations=refine, seed=seed, jobs=jobs or 0, report=report
            )
        drawn, found = inference.infer(
            posterior if trained else None, seen, samples=samples, seed=seed, out=out, refined=anew, report=report,
            maps=delta_e,
        )  # fmt: skip
        _print_table(found, inference.AS_WIDE)
        if drawn.delta_e is not None:
            from nfc_gym.inference.around import heights

            _print_ground(heights(drawn.delta_e))
        if out is not None and out.suffix == ".npz":
            say_written(out, f"{samples} draws of {' and '.join(drawn.given)}")
        elif out is not None:
            say_written(out, "the posterior given this window")


def _print_table(found: "list[Told]", as_wide: float) -> None:
    """Median and 90 % interval of each parameter; those at least `as_wide` times the prior's are marked."""
    from rich.table import Table

    table = Table("parameter", "unit", "median", "90 % interval", "width over the prior's")
    for each in found:
        note = "  not shown" if each.width >= as_wide else ""
        interval = f"{each.low:.4g} to {each.high:.4g}"
        table.add_row(each.name, each.unit, f"{each.median:.4g}", interval, f"{each.width:.2f}{note}")
    _print(table)


def _print_ground(found: "list[Height]") -> None:
    """Median and 90 % interval of delta_e at places around the robot."""
    from rich.table import Table

    table = Table("delta_e", "median, m", "90 % interval")
    for each in found:
        table.add_row(each.place, f"{each.median:.3f}", f"{each.low:.3f} to {each.high:.3f}")
    _print(table)


def _print(table: "Table") -> None:
    Console(highlight=False, emoji=False, width=None if sys.stdout.isatty() else 140).print(table)


def _asked(ctx: typer.Context, *names: str) -> dict[str, object]:
    """Those of some options that were given, in place of their defaults."""
    return {name: ctx.params[name] for name in names if str(ctx.get_parameter_source(name)).endswith("COMMANDLINE")}


def _require_used(used: bool, what: str, **options: object) -> None:
    """Refuse options that were given and would do nothing."""
    for name, value in options.items():
        if value is not None and not used:
            option = f"--{'' if value is not False else 'no-'}{name.replace('_', '-')}"
            raise InputError(f"{option}{'' if isinstance(value, bool) else f' {value}'} is {what}, or leave it out")


def _environment(posterior: Path) -> str:
    """Of which a posterior is."""
    from nfc_gym.inference.checkpoint import load as read

    found = read(posterior)[2].get("environment")
    if found is None:
        raise InputError(f"{posterior}: does not say of which environment it is: give the window as an .npz")
    return str(found)


def _window(environment: str, mapping: Path, log: str | None, until: float | None) -> "Window":
    """The window of motion of a robot, from a log of a mapping."""
    from nfc_gym.inference.posterior import Window
    from nfc_gym.measured.dataset import load
    from nfc_gym.measured.states import estimate_states
    from nfc_gym.simulate.machine import Machine
    from nfc_gym.simulate.observed import commands, observed

    logs = {each.name: each for each in load(mapping / "mapping.yaml" if mapping.is_dir() else mapping).logs}
    if log is not None and log not in logs:
        raise InputError(f"{mapping}: no log {log!r}; there are: {', '.join(logs)}")
    chosen = logs[log] if log is not None else next(iter(logs.values()))
    machine = Machine(environment)
    states = estimate_states(machine.model, chosen, raw=True)
    end = len(chosen) if until is None else int((chosen.time <= until + 1e-9).sum())
    parts = (chosen.time, states.qpos, states.qvel, commands(machine, chosen.controls))
    return Window(*observed(machine, *(part[:end] for part in parts)))
