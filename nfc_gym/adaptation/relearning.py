"""A posterior network that learns from a mission's motion, simulated again under psi of the prior."""

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from nfc_gym.adaptation.normal import stretches, with_beside
from nfc_gym.adaptation.perceived import perceived_ground
from nfc_gym.adaptation.trajectory import Trajectory
from nfc_gym.core.errors import InputError
from nfc_gym.inference.data import TensorWindows, WindowSet
from nfc_gym.inference.gains import gains
from nfc_gym.inference.network import Network
from nfc_gym.inference.posterior import NeuralPosterior
from nfc_gym.inference.progress import Report
from nfc_gym.inference.random import mixed
from nfc_gym.inference.train import TrainConfig, train
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.recorded import Recorded
from nfc_gym.simulate.residuals import families
from nfc_gym.simulate.rounds import Simulator
from nfc_gym.simulate.shard import workshop
from nfc_gym.simulate.start import observed

Array = NDArray[np.float64]
LEAST = 20  # stretches of motion, of which a quarter is kept to judge by
_HELD_OUT = 0.25  # of the trajectories
_JUDGED = 256  # windows that the gain is a mean over


def relearned(
    posterior: NeuralPosterior, trajectories: Sequence[Trajectory], environment: str, *, simulations: int,
    effects: float, motor: float, training: TrainConfig, beside: WindowSet | None, folder: Path | None,
    report: Report, seed: int, jobs: int, device: torch.device,
) -> tuple[NeuralPosterior, dict[str, Any]]:  # fmt: skip
    """A posterior that has learned from a mission's motion; arguments as of `afterwards.learn_from_mission`.

    Returns:
      It, or the given one where nothing was changed; and what was done.
    """
    machine, old = Machine(environment), posterior.network
    why = _cannot(old, machine)
    parts = None if why else _motion(machine, trajectories, seed)
    if parts is None:
        h = machine.habit.horizon
        why = why or (
            f"too little motion: {sum(len(t) // h for t in trajectories)} windows of {h} control steps, and {LEAST} in "
            "two halves or more are wanted"
        )
        return posterior, {"changed": False, "why": f"{why}; the posterior is as before"}
    names = ("states", "actions", *(n for n, wanted in _labels(old) if wanted))
    sets = []
    for k, (motion, n) in enumerate(zip(parts, (simulations, 2 * _JUDGED), strict=True)):
        simulator = Simulator(environment, effects, motor, jobs=jobs, names=names, recorded=motion)
        sets.append(TensorWindows(simulator.draw(n, np.random.default_rng(mixed(seed, 4, k)))))
    held_out, judged = sets[1].split(0.5)
    network = copy.deepcopy(old).to(device)
    before = gains(network, judged.tensors)
    windows = with_beside(sets[0], beside, seed)
    outcome = train(network, windows, held_out, training, folder=folder, report=report, scales=False, device=device)
    after = gains(network, judged.tensors)
    found: dict[str, Any] = {
        "changed": outcome.best > 0, "simulations": simulations, "stretches": [len(m) for m in parts],
        "best": outcome.best, "stopped": outcome.stopped, "gain": {"before": _mean(before), "after": _mean(after)},
    }  # fmt: skip
    if not found["changed"]:
        found["why"] = "nothing that was learned lowered the loss on motion that was held out; it is as before"
        return posterior, found
    return NeuralPosterior(network, notes=posterior.notes, parts=posterior.parts), found


def _labels(network: Network) -> tuple[tuple[str, bool], ...]:
    return ("delta_s", network.config.delta_s), ("family", network.structure is not None)


def _cannot(network: Network, machine: Machine) -> str:
    """Why a network cannot learn from a mission; empty where it can.

    Raises:
      InputError: it is of another robot.
    """
    own, size = network.prior, network.sizes
    sizes = (machine.habit.horizon, machine.kind.proprio_size, machine.kind.action_size)
    if own.names != machine.space.names or (size.horizon, size.states, size.actions) != sizes:
        raise InputError(
            f"learn_from_mission: the posterior is of {own.robot!r}, its windows have {size.horizon} steps, "
            f"{size.states} states and {size.actions} actions; those of {machine.environment} have {sizes}"
        )
    if not (np.allclose(own.low, machine.space.low) and np.allclose(own.high, machine.space.high)):
        return f"its prior is not that of {machine.environment}, from which psi would be drawn"
    if not all(own.free):
        return "it takes some of psi for known, and all of psi would be drawn"
    if network.config.elevation:
        return "it sees elevation maps, and nobody knows what a map of the mission lacked of the true ground"
    known = families(workshop(machine.environment).effects)
    if network.structure is not None and network.config.families != known:
        return f"its families of effects are others than those of {machine.environment}"
    return ""


def _motion(machine: Machine, trajectories: Sequence[Trajectory], seed: int) -> tuple[Recorded, Recorded] | None:
    """Stretches to learn from and those to judge by, of other trajectories; None where there are too few."""
    h, each = machine.habit.horizon, []
    order = np.random.default_rng(mixed(seed, 5)).permutation(len(trajectories))
    for k in order:
        t = trajectories[k]
        at = stretches(t, h, np.ones(len(t), bool), every=max(1, h // 2))
        each += [(int(k), i) for i in at]
    kept = round(_HELD_OUT * len(trajectories))
    held = {int(k) for k in order[: max(1, kept)]}
    parts = [[x for x in each if (x[0] in held) == judge] for judge in (False, True)]
    if len(trajectories) == 1:  # by time, with a window between the two
        parts = [[x for x in each if x[1] < 0.6 * len(trajectories[0])], []]
        parts[1] = [x for x in each if x[1] >= parts[0][-1][1] + h] if parts[0] else []
    if len(each) < LEAST or not all(parts):
        return None
    first, second = (_recorded(machine, trajectories, part) for part in parts)
    return first, second


def _recorded(machine: Machine, trajectories: Sequence[Trajectory], at: Sequence[tuple[int, int]]) -> Recorded:
    h = machine.habit.horizon
    states = np.array([trajectories[k].states[i : i + h + 1] for k, i in at])
    actions = np.clip(np.array([trajectories[k].actions[i : i + h] for k, i in at]), -1, 1)
    estimated = all(trajectories[k].estimate.size for k, _ in at)
    starts = np.array([trajectories[k].estimate[i] for k, i in at]) if estimated else observed(machine, states[:, 0])
    if not machine.rough:
        return Recorded(starts, states, actions)
    used = sorted({k for k, _ in at})
    maps = tuple(perceived_ground(trajectories[k])[0] for k in used)
    return Recorded(starts, states, actions, maps, np.array([used.index(k) for k, _ in at]))


def _mean(values: Array) -> tuple[float, float]:
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))
