"""`refined`: what a trained posterior says of one window, learned anew from simulations of that window's commands."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.inference.posterior import NeuralPosterior, Window
from nfc_gym.inference.progress import Report, quiet
from nfc_gym.inference.refine import FRESH, SIMULATIONS, halved, refine
from nfc_gym.inference.train import TrainConfig
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.repeated import Repeated
from nfc_gym.simulate.rounds import Simulator

Array = NDArray[np.float64]
BEGINNINGS = 2048  # windows of any motion, from which it is learned where this one may have begun
_PORTIONS, _LEAST = 10, 100  # that windows are simulated in, to say how far it is, and windows of one


def refined(
    posterior: NeuralPosterior, window: Window, *, environment: str = "", simulations: int = SIMULATIONS, seed: int = 0,
    jobs: int = 0, training: TrainConfig | None = None, device: str | torch.device = "cpu", report: Report = quiet,
) -> NeuralPosterior:  # fmt: skip
    """Psi's posterior given one window on a plane, of a network that learned from windows of the same commands.

    Args:
      posterior: trained on windows of any motion of that robot.
      window: what was observed.
      environment: id; by default the one whose windows the posterior was trained on.
      simulations: windows of the same commands in two rounds, `BEGINNINGS` and `FRESH` aside.
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
    beginnings = replace(simulator, names=("states", "start"))
    known = _in_portions(BEGINNINGS, lambda rows: beginnings.draw(len(rows), rng), report)
    again = Repeated.of(simulator, states, actions, {k: t.numpy() for k, t in known.items()})
    report.message(f"simulates {simulations} windows of these commands, in two rounds, and {FRESH} to tell its width")
    training = training or TrainConfig(patience=10, seed=seed)
    done = refine(
        posterior, window, _Told(again, report), halved(simulations, seed), training, device=device, report=report
    )
    learned = done.posterior
    assert isinstance(learned, NeuralPosterior)  # only draws of the posterior itself want a correction
    notes = posterior.notes | {"refined": simulations, "kept": done.kept[-1]}
    return NeuralPosterior(learned.network, learned.kept, notes)


@dataclass(frozen=True)
class _Told:
    """Simulates as `again` does, in portions, and says after each how far it is.

    The portions depend on the number of windows alone, so that a seed gives the same bits at any number of jobs.
    """

    again: Repeated
    report: Report

    @property
    def noise(self) -> Array:
        """As of `Repeated.noise`."""
        return self.again.noise

    def __call__(self, psi: Array, rng: np.random.Generator) -> dict[str, Any]:
        """As of `Repeated.__call__`."""
        return _in_portions(len(psi), lambda rows: self.again(psi[rows], rng), self.report)


def _in_portions(n: int, made: Callable[[NDArray[np.intp]], dict[str, Any]], report: Report) -> dict[str, Any]:
    """A batch of n windows, of which `made` makes some at a time; the report is told after each portion."""
    batches: list[dict[str, Any]] = []
    for rows in np.array_split(np.arange(n), min(_PORTIONS, max(1, n // _LEAST))):
        batches.append(made(rows))
        report.message(f"{rows[-1] + 1} of {n} windows simulated")
    return {name: torch.cat([batch[name] for batch in batches]) for name in batches[0]}
