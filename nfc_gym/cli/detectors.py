"""The command of anomaly detectors: watch; torch is loaded only inside it."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from nfc_gym.cli.outcome import outcome, say_written
from nfc_gym.cli.policies import Environment
from nfc_gym.cli.posteriors import belief_of, learned, learning


def watch(
    ctx: typer.Context,
    environment: Environment,
    out: Annotated[Path, typer.Option(metavar="FILE.safetensors", help="The detector.")],
    belief: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="What is known of its psi (.npz of psi, or a posterior that was given a window)."
        ),
    ] = None,
    width: Annotated[
        float,
        typer.Option(metavar="SHARE", min=0, max=1, help="Of the prior's range about nominal, without --belief."),
    ] = 0.02,
    windows: Annotated[int, typer.Option(metavar="N", min=100, help="To learn from, half with a fault.")] = 100_000,
    rate: Annotated[float, typer.Option(help="Share of sound windows that may alarm.")] = 0.01,
    encoder: Annotated[str, typer.Option(help="Of the motion: tcn, or nn, the faster without a GPU.")] = "tcn",
    epochs: Annotated[int | None, typer.Option(min=1, help="Passes over the windows, at most; default 40.")] = None,
    batch: Annotated[int, typer.Option(min=1, help="Windows a step.")] = 256,
    seed: Annotated[int, typer.Option(min=0, help="Of machines, faults, motion and training.")] = 0,
    jobs: Annotated[int, typer.Option(min=0, max=1024, help="Processes; 0 takes all cores.")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda; auto is a GPU where there is one.")] = "auto",
) -> None:
    """Make an anomaly detector for a robot: a network that is shown simulated windows with and without faults.

    Faults are a main body heavier or lighter, less friction, a servo that is lost or weak, and effects that the model
    lacks, all of drawn sizes. A window takes it 25 ms of a core, or 12 with --encoder nn;
    `MonitorAnomaly(env, "FILE.safetensors")` opens it. Its threshold is taken from simulated windows without a fault.

    It knows the machines that it was shown. Give --belief where psi is known to be elsewhere than nominal: else a sound
    machine of another psi is an anomaly to it. Interrupted, even killed, the same command goes on: what was made lies
    in FILE.safetensors.training, which may be deleted at the end.

    Example: nfc-gym watch JackalFlat --out watch.safetensors
    """
    with outcome(ctx, resumes=True):
        inference = learning()
        import os

        from nfc_gym.inference.faults import FaultConfig
        from nfc_gym.inference.progress import Spoken
        from nfc_gym.simulate.watch import TRAINING
        from nfc_gym.simulate.watch import watch as run

        training = replace(TRAINING, epochs=epochs or TRAINING.epochs, batch=batch, seed=seed)
        made = run(
            environment, out, None if belief is None else belief_of(belief, environment, "--belief"), windows=windows,
            rate=rate, width=width, training=training, config=FaultConfig(encoder=encoder),
            jobs=jobs or os.cpu_count() or 1, device=inference.device_of(device), report=Spoken(),
        )  # fmt: skip
        known = made.detector.calibration
        assert known is not None  # the detector was calibrated
        say_written(
            out, f"{learned(made.outcome)} ({made.outcome.seconds:.0f} s); alarms from {known.value:.2f} nats on, of "
            f"sound windows {known.low:.2g} to {known.high:.2g}",
        )  # fmt: skip
