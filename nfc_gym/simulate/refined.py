"""`refined`: what a trained posterior says of one window, learned anew from simulations of that window's commands."""

from dataclasses import replace

import numpy as np
import torch

from nfc_gym.core.errors import InputError
from nfc_gym.inference.posterior import NeuralPosterior, Window
from nfc_gym.inference.progress import Report, quiet
from nfc_gym.inference.refine import SIMULATIONS, halved, refine
from nfc_gym.inference.train import TrainConfig
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.repeated import Repeated
from nfc_gym.simulate.rounds import Simulator

BEGINNINGS = 2048  # windows of any motion, from which it is learned where this one may have begun


def refined(
    posterior: NeuralPosterior, window: Window, *, environment: str = "", simulations: int = SIMULATIONS, seed: int = 0,
    jobs: int = 0, training: TrainConfig | None = None, device: str | torch.device = "cpu", report: Report = quiet,
) -> NeuralPosterior:  # fmt: skip
    """Psi's posterior given one window on a plane, of a network that learned from windows of the same commands.

    Args:
      posterior: trained on windows of any motion of that robot.
      window: what was observed.
      environment: id; by default the one whose windows the posterior was trained on.
      simulations: windows of the same commands in two rounds, `BEGINNINGS` aside.
      seed: of simulations and training.
      jobs: processes of the simulation; 0 takes all cores.
      training: see `TrainConfig`; by default it ends after ten epochs without a better one.
      device: to train on.
      report: is told of the progress.

    Returns:
      The posterior given this window; another one is refused.

    Raises:
      InputError: a window that is not the network's, rough ground, a posterior of maps or of another robot, or one
        that does not say of which environment it is.
    """
    environment = environment or str(posterior.notes.get("environment", ""))
    if not environment:
        raise InputError("refined: the posterior does not say of which environment it is: name the environment")
    machine = Machine(environment)
    if posterior.prior.names != machine.space.names:
        raise InputError(f"refined: a posterior of {posterior.prior.robot!r}, and {machine.environment}")
    if machine.rough:
        raise InputError(f"{machine.environment}: one window's commands are repeated on a plane only")
    posterior.given(window)  # or it is refused before anything is simulated
    states, actions = np.asarray(window.states, float), np.clip(np.asarray(window.actions, float), -1, 1)
    window = Window(states, actions)  # as the machine took its commands
    measured, assumed = posterior.notes.get("noise"), machine.noise
    noise = float(np.max(measured) / np.max(assumed)) if measured else 1.0
    simulator = Simulator(environment, effects=0.0, jobs=jobs, noise=noise, names=("states", "actions"))
    rng = np.random.default_rng([seed, 2])
    report.message(f"simulates {BEGINNINGS} windows of any motion: where this one may have begun")
    known = replace(simulator, names=("states", "start")).draw(BEGINNINGS, rng)
    again = Repeated.of(simulator, states, actions, {k: t.numpy() for k, t in known.items()})
    report.message(f"simulates {simulations} windows of these commands, in two rounds")
    training = training or TrainConfig(patience=10, seed=seed)
    done = refine(posterior, window, again, halved(simulations, seed), training, device=device, report=report)
    learned = done.posterior
    assert isinstance(learned, NeuralPosterior)  # only draws of the posterior itself want a correction
    notes = posterior.notes | {"refined": simulations, "kept": done.kept[-1]}
    return NeuralPosterior(learned.network, learned.kept, notes)
