"""Simulating a true machine, and how plainly its logs show what it hides."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from .channels import true_value
from .effect import Array, Effect, Signals
from .machine import Machine, Motion

AHEAD = 0.2  # s that the machine without its effects is led from true states, to see how far it goes astray
FASTEST = 2e3  # rad/s or m/s: what is faster has gone unstable


class UnstableError(Exception):
    """The truth has no bounds: its effect is too large."""


@dataclass
class Run:
    """One log of the truth: `time` (T,), `commands` (T, nu), `values` {channel: (T, k)}, and states (T, n) each."""

    time: Array
    commands: Array
    values: dict[str, Array]
    qpos: Array
    qvel: Array
    act: Array


def with_effects(clean: mujoco.MjModel, effects: Sequence[Effect]) -> mujoco.MjModel:
    """A copy of a machine that has been given its effects' fields."""
    model = copy.copy(clean)
    for effect in effects:
        effect.build(model)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def simulate(
    machine: Machine, model: mujoco.MjModel, effects: Sequence[Effect], motion: Motion, signals: Signals,
    rng: np.random.Generator,
) -> Run:  # fmt: skip
    """One log; commands are held from row to row. `rng` makes rows uneven where the format asks for it.

    Raises:
      UnstableError: the motion has no bounds.
    """
    data = mujoco.MjData(model)
    if motion.start:
        motion.start(data)
    mujoco.mj_forward(model, data)
    for effect in effects:
        effect.begin(model, signals)
    per = round(1 / machine.rate / machine.step)
    settling = round(machine.settle * machine.rate)
    rows: list[tuple] = []
    for k in range(settling + round(machine.seconds * machine.rate)):
        t = data.time - settling * per * machine.step
        u = np.asarray(motion.policy(t, data), float)
        steps = per
        if machine.format.uneven and k >= settling:
            steps += round(rng.uniform(-1, 1) * machine.format.uneven * per)
        for s in range(steps):
            _prepare(model, data, effects, u, t + s * machine.step)
            if s == 0 and k >= settling:
                mujoco.mj_forward(model, data)
                rows.append((t, u, _values(machine, model, data, effects), *_state(data)))
            mujoco.mj_step(model, data)
        if not np.isfinite(data.qpos).all() or np.abs(data.qvel).max() > FASTEST:
            raise UnstableError
    time, commands, values, qpos, qvel, act = zip(*rows, strict=True)
    by_channel = {c.name: np.array([v[c.name] for v in values]) for c in machine.channels}
    return Run(np.array(time), np.array(commands), by_channel, np.array(qpos), np.array(qvel), np.array(act))


def _prepare(
    model: mujoco.MjModel, data: mujoco.MjData, effects: Sequence[Effect], u: Array, t: float
) -> None:  # fmt: skip
    """Commands and forces of one physics step."""
    given = u.copy()
    for effect in effects:
        given = effect.command(given, data, t)
    data.ctrl[:] = given
    data.qfrc_applied[:] = 0
    data.xfrc_applied[:] = 0
    for effect in effects:
        effect.push(model, data)


def _values(
    machine: Machine, model: mujoco.MjModel, data: mujoco.MjData, effects: Sequence[Effect]
) -> dict[str, Array]:
    out = {}
    for channel in machine.channels:
        value = true_value(model, data, channel.name)
        for effect in effects:
            value = effect.read(channel.name, value)
        out[channel.name] = value
    return out


def _state(data: mujoco.MjData) -> tuple[Array, Array, Array]:
    return data.qpos.copy(), data.qvel.copy(), data.act.copy()


def visible(machine: Machine, clean: mujoco.MjModel, runs: Sequence[Run]) -> dict[str, float]:
    """How far, in deviations of a sample's noise, the machine without its effects is off after `AHEAD`; by channel."""
    ahead = round(AHEAD * machine.rate)
    off: dict[str, list[float]] = {c.name: [] for c in machine.channels}
    data = mujoco.MjData(clean)
    for run in runs:
        for k in range(ahead, len(run.time) - ahead - 1, 2 * ahead):
            _lead(machine, clean, data, run, k, ahead)
            for channel in machine.channels:
                true, told = true_value(clean, data, channel.name), run.values[channel.name][k + ahead]
                if channel.order:  # a quaternion: twice the difference is the angle
                    error = 2 * float(np.linalg.norm(true * np.sign(true @ told) - told))
                else:
                    error = float(np.sqrt(np.mean((true - told) ** 2)))
                off[channel.name].append(error / channel.noise)
    return {name: float(np.sqrt(np.mean(np.square(errors)))) for name, errors in off.items()}


def _lead(machine: Machine, model: mujoco.MjModel, data: mujoco.MjData, run: Run, k: int, ahead: int) -> None:
    """From the true state of row k on, under what was commanded, over so many rows."""
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:], data.act[:] = run.qpos[k], run.qvel[k], run.act[k]
    for row in range(k, k + ahead):
        data.ctrl[:] = run.commands[row]
        for _ in range(round((run.time[row + 1] - run.time[row]) / machine.step)):
            mujoco.mj_step(model, data)
    data.ctrl[:] = run.commands[k + ahead]
    mujoco.mj_forward(model, data)
