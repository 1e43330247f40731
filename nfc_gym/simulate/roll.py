"""Windows rolled out together: each row with its own psi, ground, motion and effect, recorded after its own warm-up."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mujoco.batch import SimulationError
from numpy.typing import NDArray

from nfc_gym.envs.contract import broken
from nfc_gym.envs.simulations import Simulations
from nfc_gym.simulate.drive import Drive, drive_of
from nfc_gym.simulate.ground import begin
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.policy import Policy
from nfc_gym.simulate.recorded import Recorded, place
from nfc_gym.simulate.residuals import Given, Residuals
from nfc_gym.terrain import Heightfield

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
_EXPLORE = 0.3  # of the excitation that is added to a policy's actions


@dataclass(frozen=True)
class Task:
    """What n rows are to do.

    Attributes:
      psi: (n, d) physical units.
      which: (n,) map.
      start: (n, `ground.count`) uniform numbers of the start.
      signal: (n, W + H, channels) excitation; W is the longest warm-up.
      jitter: (n, W + H, actions) what the motors add to the actions; it is not recorded.
      warm: (n,) control steps before the window, W at most; rows that need fewer wait.
      guided: (n,) rows that a policy moves.
      given: effects, rows of each contiguous; the rest have none.
      recorded: (n) whose starts and actions take the place of `start`, `signal` and the policy; `warm` is then 0.
    """

    psi: Array
    which: NDArray[np.intp]
    start: Array
    signal: Array
    jitter: Array
    warm: NDArray[np.intp]
    guided: Flags
    given: Sequence[Given]
    recorded: Recorded | None = None


@dataclass(frozen=True)
class Rolled:
    """Windows; rows that came apart (`unstable`) or whose episode ended before the window did (`ended`) are void."""

    states: NDArray[np.float32]
    actions: NDArray[np.float32]
    delta_s: Array
    pose: NDArray[np.float32]
    start: Array
    unstable: Flags
    ended: Flags


class Shadow:
    """The same rows without their effects: one control step from each of the states that the others reach."""

    def __init__(self, machine: Machine, task: Task, rows: NDArray[np.intp], maps: list[Heightfield], nthread: int):
        self.rows = rows
        self.sims = machine.simulations(max(len(rows), 1), nthread, maps)
        if len(rows):
            given = {"psi": task.psi[rows]} | ({"terrain_id": task.which[rows]} if machine.rough else {})
            self.sims.begin(np.arange(len(rows)), given)

    def step(self, machine: Machine, of: Simulations, state: Array, action: Array, acted: Array, alive: Flags) -> Array:
        """proprio (k, s) one control step after `state` (k, nstate) under `action`, by the motors `acted`, (k, a)."""
        if not len(self.rows):
            return np.zeros((0, machine.kind.proprio_size))
        sims, robot = self.sims, self.sims.robot
        sims.batch.state[...] = state
        view = sims.view
        view.task = {name: value[self.rows] for name, value in of.view.task.items()}
        view.now = robot.derive(view)
        view.ctrl[...] = robot.actuate(acted, view)
        step(sims, alive[self.rows], machine.kind.frame_skip)
        view.task.update(robot.advance(view, action))
        view.before, view.now = view.now, robot.derive(view)
        return np.concatenate(robot.proprio(view), -1)


def step(sims: Simulations, rows: Flags, steps: int) -> None:
    """Physics steps of some simulations; one whose solver runs out of memory gets nan for its velocity."""
    if not rows.any():
        return
    try:
        sims.batch.step(rows, nstep=steps)
    except SimulationError as error:  # the solver ran out of memory in some; the others went on
        sims.view.qvel[error.ids] = np.nan


def acted_on(sims: Simulations, residuals: Residuals, rows: Flags, steps: int) -> None:
    """Physics steps of some simulations under the commands that they have, with their effects at work."""
    residuals.command(sims.view.ctrl)
    step(sims, rows & ~residuals.between, steps)
    if residuals.parts:
        for _ in range(steps):
            residuals.act()
            step(sims, rows & residuals.between, 1)
        residuals.rest()


def roll(machine: Machine, task: Task, maps: list[Heightfield], policy: Policy | None, nthread: int) -> Rolled:
    """Simulate the rows of a task.

    Args:
      machine: the robot.
      task: what they do.
      maps: of the ground.
      policy: what moves the guided rows.
      nthread: threads; the result does not depend on them.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # what comes apart is counted
        return _roll(machine, task, maps, policy, nthread)


def _begun(machine: Machine, sims: Simulations, task: Task) -> Residuals:
    """Simulations at their starts, under the task's psi and with its effects, which are given back."""
    begin(machine, sims, task.psi, task.which, task.start)
    if task.recorded is not None:
        place(machine, sims, task.recorded.starts, task.recorded.states[:, 0])
    for each in task.given:
        each.effect.bind(sims.model)
    residuals = Residuals(sims, task.given)
    sims.batch.forward()
    sims.view.now = sims.robot.derive(sims.view)
    return residuals


def _commanded(sims: Simulations, task: Task, t: int, drive: Drive, policy: Policy | None) -> Array:
    """(n, a) actions of a control step: excitation under feedback, a policy's, or those that were recorded."""
    action = drive(sims.view, task.signal[:, t]) if task.recorded is None else task.recorded.actions[:, t]
    if policy is not None and task.guided.any():
        action[task.guided] = policy.act(sims, task.guided) + _EXPLORE * task.signal[task.guided, t]
    # What is recorded is what was commanded, to the bit.
    return np.clip(action, -1, 1).astype(np.float32).astype(np.float64)


def _roll(machine: Machine, task: Task, maps: list[Heightfield], policy: Policy | None, nthread: int) -> Rolled:
    n, horizon, kind = len(task.psi), machine.habit.horizon, machine.kind
    longest = task.signal.shape[1] - horizon
    sims = machine.simulations(n, nthread, maps)
    robot, view, batch = sims.robot, sims.view, sims.batch
    residuals = _begun(machine, sims, task)
    drive = drive_of(robot, sims.model)
    rows = np.concatenate([np.arange(n)[:0], *(np.arange(e.rows.start, e.rows.stop) for e in task.given)])
    shadow = Shadow(machine, task, rows, maps, nthread)
    unstable, ended = np.zeros(n, bool), np.zeros(n, bool)
    states = np.zeros((n, horizon + 1, kind.proprio_size), np.float32)
    actions = np.zeros((n, horizon, kind.action_size), np.float32)
    pose = np.zeros((n, horizon + 1, 7), np.float32)
    delta = np.zeros((n, kind.proprio_size))
    start = np.zeros((n, batch.state.shape[1]))
    shown = np.zeros((len(rows), kind.proprio_size))
    for t in range(longest + horizon):
        alive = (t >= longest - task.warm) & ~unstable & ~ended
        action = _commanded(sims, task, t, drive, policy)
        acted = np.clip(action + task.jitter[:, t], -1, 1)
        k = t - longest
        if k == 0:
            start[...] = batch.state
        if k >= 0:
            states[:, k] = np.concatenate(robot.proprio(view), -1)
            pose[:, k] = view.qpos[:, :7]
            actions[:, k] = action
            shown = shadow.step(machine, sims, batch.state[rows], action[rows], acted[rows], alive)
        view.ctrl[...] = robot.actuate(acted, view)
        acted_on(sims, residuals, alive, kind.frame_skip)
        apart = alive & broken(view)
        if apart.any():
            unstable |= apart
            batch.reset(np.flatnonzero(apart), sims.rest)
        view.task.update(robot.advance(view, action))
        view.before, view.now = view.now, robot.derive(view)
        if task.recorded is None:  # what was recorded went on, so that these have to, or they could not be compared
            ended |= alive & ~apart & robot.terminated(view)
        if k >= 0:
            delta[rows] += machine.difference(np.concatenate(robot.proprio(view), -1)[rows], shown)
    states[:, horizon] = np.concatenate(robot.proprio(view), -1)
    if task.recorded is not None:  # commands, last actions and aims are the task's, not the simulation's
        states[:, :, ~machine.told] = task.recorded.states[:, :, ~machine.told]
    pose[:, horizon] = view.qpos[:, :7]
    unstable |= ~ended & ~(np.isfinite(states).all((1, 2)) & np.isfinite(delta).all(1))
    return Rolled(states, actions, delta / horizon, pose, start, unstable, ended)
