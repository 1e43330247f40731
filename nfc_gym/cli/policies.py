"""Commands of policies: pretrain, play, adapt; torch is loaded only inside them."""

import math
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from nfc_gym.cli.outcome import outcome
from nfc_gym.core import InputError, kinds

Environment = Annotated[str, typer.Argument(metavar="ID", help="For instance nfc_gym/JackalFlat-v0, or JackalFlat.")]


def pretrain(
    ctx: typer.Context,
    environment: Environment,
    out: Annotated[Path, typer.Option(metavar="FILE.safetensors", help="The policy.")],
    steps: Annotated[int, typer.Option(metavar="N", min=1, help="Control steps of all simulations together.")],
    seed: Annotated[int, typer.Option(min=0, help="Of weights, actions, psi and terrain.")] = 0,
    envs: Annotated[int, typer.Option(min=1, help="Simulations at once.")] = 1024,
    net: Annotated[str, typer.Option(help="paper: layers of 1024 and 512; small: 256 and 128.")] = "small",
    spread: Annotated[
        float, typer.Option(metavar="SHARE", help="Psi is uniform over this share of its prior, around nominal.")
    ] = 0.5,
    task: Annotated[
        str | None, typer.Option(help="Of Jackal and Quadcopter: goal, or figure8. Default: the environment's own.")
    ] = None,
    device: Annotated[str, typer.Option(help="Of the networks: auto, cpu or cuda.")] = "auto",
    threads: Annotated[
        int, typer.Option(min=0, max=1024, help="Of the physics; 0 takes all cores. With --ray, of each worker.")
    ] = 0,
    ray: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Simulate on a Ray cluster: its address, auto, or local to start one."),
    ] = None,
    workers: Annotated[
        int, typer.Option(metavar="N", min=0, help="Of the cluster; 0: as many as it has cores for.")
    ] = 0,
    seconds: Annotated[
        float | None, typer.Option(metavar="S", min=1, help="Stop after so long with what was learned by then.")
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(metavar="POLICY", help="First weights: a file, or an id; a Flat policy will do for Rough."),
    ] = None,
) -> None:
    """Train a policy by PPO under random physics and terrain, before any robot is met.

    The simulations run on the processor, all in one batch on --threads threads, the networks on a GPU where there
    is one. Interrupted, even killed, the same command goes on from the last state, FILE.safetensors.training, which
    may be deleted at the end; curves are in FILE.safetensors.log. A loss that comes apart stops the run, and the
    last good weights are kept. At the end the policy is judged over 64 whole episodes in the nominal world.

    With --ray the simulations are shared by the workers of a Ray cluster (extra ray), and learning stays here. A
    worker that dies is replaced. The same command goes on without a cluster, or with other --workers.

    Example: nfc-gym pretrain JackalFlat --steps 5000000 --out jackal.safetensors
    """
    with outcome(ctx, resumes=True):
        kinds.require_kind(out, kinds.POLICY)
        from nfc_gym.adaptation import pretrain as run

        run(
            environment, out, steps=steps, seed=seed, envs=envs, net=net, spread=spread, task=task, device=device,
            threads=threads, seconds=seconds, start=start, ray=ray, workers=workers, console=Console(),
        )  # fmt: skip


def play(
    ctx: typer.Context,
    environment: Environment,
    policy: Annotated[
        Path | None, typer.Option(metavar="FILE.safetensors", help="Default: the one that comes with the package.")
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="A video (.mp4) or a sheet (.png).")] = None,
    episodes: Annotated[int, typer.Option(min=1, help="How many.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Of the first; each has the next.")] = 0,
) -> None:
    """Show what a policy does in the nominal world, and print what each episode came to.

    No screen is needed: --out writes a video, or a picture with a dozen moments of the first episode.

    Example: nfc-gym play AntFlat --out ant.mp4
    """
    with outcome(ctx):
        from nfc_gym.adaptation.play import play as run

        run(environment, policy, out, episodes=episodes, seed=seed, console=Console())


def adapt(
    ctx: typer.Context,
    environment: Environment,
    effects: Annotated[
        Path, typer.Option(metavar="PATH", help="What close-loop wrote: its folder, effects.yaml or model.xml.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="For policy.safetensors, report.json, report.html.")],
    policy: Annotated[
        str | None,
        typer.Option(
            metavar="POLICY", help="To begin with: a .safetensors file, or an id. Default: the environment's own."
        ),
    ] = None,
    world: Annotated[
        Path | None,
        typer.Option(metavar="PATH", help="Plays the machine, a path as --effects: judged in, never learned from."),
    ] = None,
    steps: Annotated[int, typer.Option(metavar="N", min=1, help="Of all simulations together.")] = 500_000,
    envs: Annotated[int, typer.Option(min=1, help="Simulations at once.")] = 64,
    vary: Annotated[
        float,
        typer.Option(
            metavar="X", min=0, max=10, help="Draw sizes over X times their 95 % intervals; 0: the fitted ones."
        ),
    ] = 1.0,
    episodes: Annotated[int, typer.Option(min=2, help="That judge a policy in each world.")] = 100,
    ablate: Annotated[
        bool, typer.Option("--ablate", help="Adapt once more without each effect: what was it worth to know it?")
    ] = False,
    condition: Annotated[
        str | None, typer.Option(metavar="NAME", help="Which day's values, where effects differ between days.")
    ] = None,
    signal: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="What an effect reads, for instance exo:supply=24; repeatable."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="The same arguments and seed give the same policy.")] = 0,
    device: Annotated[str, typer.Option(help="Of the networks: auto, cpu or cuda.")] = "auto",
    threads: Annotated[int, typer.Option(min=0, max=1024, help="Of the physics; 0 takes all cores.")] = 0,
) -> None:
    """Fine-tune a policy in the model that close-loop extended, and say what that is worth.

    The named effects and the calibrated parameters go into the environment, and PPO goes on from the policy. The
    page says the return before and after, each with an interval: in the nominal model, in the extended one, and
    there without each effect in turn. That is not the machine: only --world, a third model that plays it, shows
    what adapting is worth where the model is not exact.

    Kept are the weights that did best on the way, the given ones included. Interrupted, even killed, the same
    command goes on and ends with the same policy.

    An effects.yaml may be written by hand: `version: 1`, `psi: {base_mass: 18}`, and `effects:`, a list of
    `{family: loss, where: rear_left, parameters: {fraction: 0.7}}`; with `{value: 0.7, low: 0.6, high: 0.8}` in
    place of the number, --vary draws it.

    Example: nfc-gym adapt JackalFlat --effects result --out adapted
    """
    with outcome(ctx, resumes=True):
        kinds.require_kind(out, kinds.ADAPTED)
        kinds.require_kind(out / "policy.safetensors", kinds.POLICY)
        from nfc_gym.adaptation.extended import read_found

        read_found(effects)  # what is wrong with a file is told before torchrl is loaded, which takes many seconds
        from nfc_gym.adaptation import FineTuneConfig, hand_over

        hand_over(
            environment, effects, out, policy=policy, world=world, episodes=episodes, ablate=ablate,
            config=FineTuneConfig(steps=steps, envs=envs, vary=vary, seed=seed), condition=condition,
            signals=_signals(signal or []), device=device, threads=threads, console=Console(),
        )  # fmt: skip


def _signals(given: list[str]) -> dict[str, float]:
    """`name=value` each."""
    found = {}
    for each in given:
        name, _, value = each.partition("=")
        try:
            found[name] = float(value)
        except ValueError:
            found[name] = math.nan
        if not name or not math.isfinite(found[name]):
            raise InputError(f"--signal {each!r}: want NAME=VALUE with a finite number, for instance exo:supply=24")
    return found
