"""`refined`: what one window tells of psi, by simulations of that window's own commands."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.inference.jobs import require_commands
from nfc_gym.inference.normal import Normal, NormalPosterior
from nfc_gym.inference.paired import SIMULATIONS, close_in
from nfc_gym.inference.posterior import NeuralPosterior, Window
from nfc_gym.inference.progress import Report, quiet
from nfc_gym.inference.space import PriorBox
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.repeated import Repeated, last_of
from nfc_gym.simulate.rounds import Simulator

Array = NDArray[np.float64]
BEGINNINGS = 2048  # windows of any motion, from which it is learned where this one may have begun
_DRAWS = 1000  # of the posterior that it begins with
# Where what the machine does is far from linear, the normal may be altogether wrong and not know it, as of two of 32
# Jackals (docs/posteriors.md): so much is left to what was believed before.
DOUBT = 0.02


def refined(
    posterior: NeuralPosterior | None, window: Window, *, environment: str = "", simulations: int = SIMULATIONS,
    seed: int = 0, jobs: int = 0, report: Report = quiet,
) -> NormalPosterior:  # fmt: skip
    """Psi's posterior given one window on a plane, from simulations of the same commands (`inference.paired`).

    Args:
      posterior: trained on windows of any motion of that robot: where the first round lies, and what is believed where
        the answer is wrong. None begins with the prior.
      window: what was observed; the last H steps count.
      environment: id; by default the one whose windows the posterior was trained on.
      simulations: windows of the same commands, at most; `BEGINNINGS` aside.
      seed: of simulations.
      jobs: processes of the simulation; 0 takes all cores.
      report: is told of the progress.

    Returns:
      The posterior given this window.

    Raises:
      InputError: a window that is not the robot's, rough ground, a posterior of maps or of another robot, one that does
        not say of which environment it is, or too few simulations.
    """
    notes: dict[str, Any] = {} if posterior is None else posterior.notes
    environment = environment or str(notes.get("environment", ""))
    if not environment:
        raise InputError("refined: the posterior does not say of which environment it is: name the environment")
    machine = Machine(environment)
    prior = PriorBox.of(machine.space, machine.kind.name)
    if posterior is not None and posterior.prior.names != prior.names:
        raise InputError(f"refined: a posterior of {posterior.prior.robot!r}, and {machine.environment}")
    if machine.rough:
        raise InputError(f"{machine.environment}: one window's commands are repeated on a plane only")
    rng = np.random.default_rng([seed, 2])
    first = Normal.prior(prior.size)
    if posterior is not None:
        drawn = posterior.of("psi").given(window).sample(_DRAWS, rng).psi
        first = Normal.through(prior.to_z(np.asarray(drawn)))
    # Before anything is simulated.
    states, actions = last_of(machine, np.asarray(window.states, float), np.asarray(window.actions, float))
    require_commands(actions, len(actions), "window")
    actions = np.clip(actions, -1, 1)
    noise = float(np.max(notes["noise"]) / np.max(machine.noise)) if notes.get("noise") else 1.0
    simulator = Simulator(environment, effects=0.0, jobs=jobs, noise=noise, names=("states", "start"))
    report.message(f"simulates {BEGINNINGS} windows of any motion: where this one may have begun")
    known = {name: t.numpy() for name, t in simulator.draw(BEGINNINGS, rng).items()}
    again = Repeated.of(replace(simulator, names=("states",)), states, actions, known, rng)
    report.message(f"simulates these commands {simulations} times at most")
    found = close_in(again, first.beside(again.opening.size), prior.size, simulations, seed, report)
    told = {key: notes[key] for key in ("states",) if key in notes}
    kept = {"environment": machine.environment, "refined": simulations} | told
    return NormalPosterior(prior, found.first(prior.size), kept, DOUBT, first)
