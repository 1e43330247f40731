"""Drawing a case: the true numbers, what is hidden and how large it is, and its logs, all from one seed."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from .channels import UNITS, Signal
from .effect import Array, Effect, Rng, Signals
from .machine import Case, Machine, Make, log_between
from .simulation import Run, UnstableError, simulate, visible, with_effects

TRIES = 4  # simulations in search of the size
NEAR = 1.35  # a size whose effect shows by the wanted number of deviations up to this factor will do


@dataclass
class Drawn:
    """A machine as drawn: `psi` in the parameters' order, its effects, its logs, and the logs' other signals."""

    case: Case
    seed: int
    psi: list[float]
    effects: Sequence[Effect]
    runs: list[Run]
    signals: list[Signals]
    shown: dict[str, float]


def draw(case: Case, seed: int) -> Drawn:
    """The same for the same seed. Truth, motions and their starts are drawn apart: a search repeats the motions."""
    machine = case.machine
    truth, courses = (np.random.default_rng([seed, part]) for part in (1, 2))
    psi = [p.draw(machine.user_model(), truth) for p in machine.parameters]
    clean = machine.true_model(psi)
    seeds = [int(s) for s in courses.integers(2**32, size=machine.logs)]
    signals = [_signals(machine.signals, courses) for _ in seeds]
    effects: Sequence[Effect] = []
    if case.hide:
        make = case.hide(truth)
        effects = make(_size(case, clean, make, log_between(truth, *case.shown), seeds, signals))
    runs = _runs(machine, clean, effects, seeds, signals)
    shown = visible(machine, clean, runs[:3]) if effects else {}
    return Drawn(case, seed, psi, effects, runs, signals, shown)


def _signals(wanted: Sequence[Signal], rng: Rng) -> Signals:
    return {s.name: s.draw(rng) for s in wanted}


def _runs(
    machine: Machine, clean: mujoco.MjModel, effects: Sequence[Effect], seeds: Sequence[int], signals: Sequence[Signals]
) -> list[Run]:
    model, out = with_effects(clean, effects), []
    for seed, signal in zip(seeds, signals, strict=True):
        rng = np.random.default_rng(seed)
        out.append(simulate(machine, model, effects, machine.motion(rng), signal, rng))
    return out


def _size(
    case: Case,
    clean: mujoco.MjModel,
    make: Make,
    wanted: float,
    seeds: Sequence[int],
    signals: Sequence[Signals],
) -> float:
    """The size within the case's bounds at which the plainest channel shows about `wanted`, on two of the logs."""
    low, high = case.sizes
    size = float(np.sqrt(low * high))
    for _ in range(TRIES if high > low else 0):
        try:
            effects = make(size)
            runs = _runs(case.machine, clean, effects, seeds[:2], signals[:2])
        except UnstableError:
            high = size * 0.7
            size = max(low, size * 0.3)
            continue
        shown = max(visible(case.machine, clean, runs).values())
        if 1 / NEAR < shown / wanted < NEAR:
            break
        size = float(np.clip(size * np.clip((wanted / max(shown, 1e-9)) ** 0.9, 0.05, 5.0), low, high))
    return size


def columns(drawn: Drawn, log: int) -> dict[str, Array]:
    """One log as it is recorded: column name to (T,), in the units of the mapping file, with the sensors' noise."""
    machine, run = drawn.case.machine, drawn.runs[log]
    rng = np.random.default_rng([drawn.seed, 3, log])
    rows, form = len(run.time), machine.format
    stamps = form.epoch + run.time + (rng.normal(0, form.jitter, rows) if form.jitter else 0.0)
    out = {"t": stamps / UNITS.get(form.clock, 1.0)}
    for i, control in enumerate(machine.controls):
        out[control.column] = run.commands[:, i] / UNITS.get(control.unit, 1.0)
    for channel in machine.channels:
        told = channel.sensed(run.values[channel.name], rng) / UNITS.get(channel.unit, 1.0)
        if channel.rate:  # a slow sensor leaves the rows between its samples empty
            told[np.arange(rows) % round(machine.rate / channel.rate) != 0] = np.nan
        for i, name in enumerate(channel.columns):
            out[name] = told[:, i]
    for signal in machine.signals:
        course = np.array([drawn.signals[log][signal.name](t) for t in run.time])
        out[signal.column] = course + rng.normal(0, signal.noise, rows)
    return out
