"""A log's motion as its robot's environment would have observed it: what a posterior is given."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.simulate.machine import Machine

Array = NDArray[np.float64]
FEELING = ("ant", "humanoid")  # robots whose observation holds forces that positions and velocities do not tell
_OFF = 0.25  # of a control step: how far a sample may lie from its place on the grid
_EXPLAINED = 1e-3  # of the commands' range: what no action may leave of a command


def commands(machine: Machine, controls: Mapping[str, Array]) -> Array:
    """(T, nu) commands in the order of the robot's actuators, from a log's `ctrl:<actuator>`.

    Raises:
      InputError: one is missing.
    """
    names = [f"ctrl:{machine.model.actuator(i).name}" for i in range(machine.model.nu)]
    missing = [n for n in names if n not in controls]
    if missing:
        raise InputError(f"log: {missing[0]} is missing; {machine.environment} has {', '.join(names)}")
    return np.stack([controls[n] for n in names], 1)


def observed(machine: Machine, time: Array, qpos: Array, qvel: Array, ctrl: Array) -> tuple[Array, Array]:
    """States (n + 1, s) and actions (n, a) of a window of n control steps, as `nfc-gym simulate` records them.

    What a log does not say of the task (a goal, a commanded velocity) is what a reset gives; psi does not depend on it.

    Args:
      machine: the robot.
      time: (T,) s, from 0; at 50 Hz or a multiple of it.
      qpos, qvel: (T, nq), (T, nv) measured, in the order of the robot's model.
      ctrl: (T, nu) commands as they reached the actuators.

    Raises:
      InputError: a robot whose observation a log cannot say, samples at other times than control steps, or commands
        that no action makes.
    """
    require_unfeeling(machine)
    rows = _grid(time, machine.dt)
    actions = actions_of(machine, ctrl[rows[:-1]])
    return proprio(machine, qpos[None, rows], qvel[None, rows], actions[None])[0], actions


def require_unfeeling(machine: Machine) -> None:
    """Raises `InputError` for a robot whose observation holds forces, which positions and velocities do not tell."""
    if machine.kind.name in FEELING:
        raise InputError(
            f"{machine.environment}: its observation holds contact forces, which positions and velocities do not "
            "tell; give the observed states themselves, in an .npz"
        )


def proprio(machine: Machine, qpos: Array, qvel: Array, actions: Array) -> Array:
    """(W, H+1, s) observations along W stretches of motion; what motion does not say of a task is what a reset gives.

    Args:
      machine: the robot.
      qpos, qvel: (W, H+1, nq), (W, H+1, nv) at control steps.
      actions: (W, H, a) between them.
    """
    machine = Machine(machine.environment.replace("Rough", "Flat"))  # nothing that is read here depends on the ground
    n = len(qpos)
    sims = machine.simulations(n, 1, [])
    sims.begin(np.arange(n), {"psi": np.tile(machine.space.nominal, (n, 1))})
    robot, view, out = sims.robot, sims.view, []
    for k in range(qpos.shape[1]):
        view.qpos[...], view.qvel[...] = qpos[:, k], qvel[:, k]
        sims.batch.forward()
        if k:
            view.task.update(robot.advance(view, actions[:, k - 1]))
        view.before, view.now = (view.now if k else robot.derive(view)), robot.derive(view)
        out.append(np.concatenate(robot.proprio(view), -1))
    return np.stack(out, 1)


def _grid(time: Array, dt: float) -> NDArray[np.intp]:
    """Rows of the samples at whole control steps."""
    wanted = np.arange(0, time[-1] + _OFF * dt, dt)
    after = np.searchsorted(time, wanted).clip(1, len(time) - 1)
    rows = np.where(wanted - time[after - 1] < time[after] - wanted, after - 1, after)
    off = np.abs(time[rows] - wanted)
    if off.max() > _OFF * dt:
        k = int(off.argmax())
        raise InputError(
            f"log: no sample within {1e3 * _OFF * dt:.0f} ms of {wanted[k]:.3f} s; a posterior's windows have one "
            f"every {1e3 * dt:.0f} ms: record at {1 / dt:.0f} Hz or a multiple of it"
        )
    return rows


def actions_of(machine: Machine, ctrl: Array) -> Array:
    """(n, a) actions whose commands are `ctrl` (n, nu): commands depend on them linearly, up to a constant.

    Raises:
      InputError: commands that no action makes.
    """
    robot, size = machine.settings.robot(machine.model), machine.kind.action_size
    sims = machine.simulations(size + 1, 1, [])
    sims.begin(np.arange(size + 1), {"psi": np.tile(machine.space.nominal, (size + 1, 1))})
    at = np.asarray(robot.actuate(np.concatenate([np.zeros((1, size)), np.eye(size)]), sims.view), float)
    slope = at[1:] - at[0]
    actions = np.linalg.lstsq(slope.T, (ctrl - at[0]).T, rcond=None)[0].T
    left = np.abs(actions @ slope + at[0] - ctrl).max(0)
    if (left > _EXPLAINED * np.abs(slope).sum(0)).any():
        worst = int((left / np.abs(slope).sum(0)).argmax())
        name = machine.model.actuator(worst).name
        raise InputError(f"log: the commands of {name!r} are {left[worst]:.3g} off what any action makes")
    return actions
