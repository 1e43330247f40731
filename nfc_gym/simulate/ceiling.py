"""The ceiling: what a window can tell of psi at most, by the Fisher information of its noisy states (`fisher`)."""

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.envs.simulations import Simulations
from nfc_gym.inference.windows import Batch
from nfc_gym.physics.residual import Components
from nfc_gym.physics.state import move
from nfc_gym.simulate import starts
from nfc_gym.simulate.fisher import STEP, Array, Ceiling, bounds, information
from nfc_gym.simulate.ground import made
from nfc_gym.simulate.machine import MOTOR, Machine
from nfc_gym.simulate.roll import step

CLOUD, PAIRS = 256, 32  # draws of the motors' noise, see `information`


def ceiling(
    environment: str,
    windows: Batch,
    noise: Array | None = None,
    motor: float = MOTOR,
    *,
    width: float = STEP,
    cloud: int = CLOUD,
    pairs: int = PAIRS,
    seed: int = 0,
    nthread: int = 1,
    before: Array | None = None,
) -> Ceiling:
    """What windows can tell of psi at most.

    Args:
      environment: id.
      windows: as `Windows` gives them: `psi`, `start`, `actions` and the terrain are read. The effect, if one was
        injected, is left out: the ceiling is that of psi in the simulator as it is.
      noise: (s,) standard deviation of each entry of the states; None is the robot's own (`Machine.noise`).
      motor: standard deviation of the motors' noise, as the windows were simulated with; 0 for none.
      width, cloud, pairs: step of u, and draws, see `information`.
      seed: of the motors' noise.
      nthread: threads of the simulation; 0 takes every core.
      before: (nv, nv) covariance of the velocities with which windows begin (`starts.spread`): then they are known
        through the first observation alone, as to whoever infers. None takes them as known exactly, a higher ceiling.

    Raises:
      InputError: windows or noise of another robot.
    """
    machine = Machine(environment)
    sd = machine.noise if noise is None else np.asarray(noise, float)
    _require(machine, windows, sd)
    if motor == 0:
        cloud, pairs = 0, 1
    n, horizon, size = windows["actions"].shape
    found = []
    for i in range(n):
        rng = np.random.default_rng([seed, i])
        jitter = motor * rng.standard_normal((cloud + pairs, horizon, size))
        one = {name: value[i : i + 1] for name, value in windows.items()}
        u = np.asarray(windows["psi"][i], float)
        off = np.zeros((cloud + pairs, machine.model.nv))
        if before is not None:
            first = _first(machine, one, u, starts.STEP * np.eye(1 + machine.model.nv)[:, 1:])
            off = rng.standard_normal(off.shape) @ starts.left_open(first, sd, before).T

        def simulator(u: Array, draw: NDArray[np.intp], one: Batch = one, e: Array = jitter, off: Array = off) -> Array:
            return replayed(machine, one, u, e[draw], nthread, off=off[draw])

        found.append(information(simulator, u, np.tile(sd, horizon), width, cloud, pairs))
    return bounds(np.array(found))


def _require(machine: Machine, windows: Batch, noise: Array) -> None:
    """Refuse windows or noise of another robot."""
    if noise.shape != (machine.kind.proprio_size,):
        raise InputError(f"noise has shape {noise.shape}, want ({machine.kind.proprio_size},): one of each state entry")
    got = windows["psi"].shape[-1], windows["actions"].shape[-1]
    if got != (len(machine.space), machine.kind.action_size):
        raise InputError(
            f"ceiling: windows of {got[0]} parameters and {got[1]} actions; {machine.environment} has "
            f"{len(machine.space)} and {machine.kind.action_size}"
        )


def replayed(
    machine: Machine, window: Batch, u: Array, jitter: Array, nthread: int, delta_s: Array | None = None,
    off: Array | None = None,
) -> Array:  # fmt: skip
    """States (m, H s) after each control step of one window from its start, under other psi, u (m, d).

    Args:
      machine: the robot.
      window: its arrays, with a leading axis of 1.
      u: (m, d).
      jitter: (m, H, a) added to the actions.
      nthread: threads.
      delta_s: (m, s) added to the physical state after each control step; None adds nothing.
      off: (m, nv) added to the velocities of the start, in the robot's own frame; None adds nothing.

    Returns:
      nan for a simulation that comes apart.
    """
    kind, m = machine.kind, len(u)
    sims = _begun(machine, window, u, nthread, off)
    robot, view, batch = sims.robot, sims.view, sims.batch
    names, model = list(machine.state_names), sims.model
    parts = None if delta_s is None else Components(model, names, len(names))
    out = [np.concatenate(robot.proprio(view), -1)]
    for action, noise in zip(window["actions"][0].astype(np.float64), np.moveaxis(jitter, 1, 0), strict=True):
        commanded = np.tile(action, (m, 1))
        view.ctrl[...] = robot.actuate(np.clip(action + noise, -1, 1), view)
        step(sims, np.ones(m, bool), kind.frame_skip)
        if parts is not None and delta_s is not None:
            change = parts.tangent(np.array(view.qpos), delta_s)
            move(model, view.qpos, np.ascontiguousarray(change[:, : model.nv]))
            view.qvel[...] += change[:, model.nv :]
            batch.forward()
        view.task.update(robot.advance(view, commanded))
        view.before, view.now = view.now, robot.derive(view)
        out.append(np.concatenate(robot.proprio(view), -1))
    states = np.stack(out, 1)
    with np.errstate(invalid="ignore"):
        states[..., machine.angles] = np.unwrap(states[..., machine.angles], axis=1)
    states = states[:, 1:].reshape(m, -1)
    return np.where(np.isfinite(states).all(1, keepdims=True), states, np.nan)


def _begun(machine: Machine, window: Batch, u: Array, nthread: int, off: Array | None) -> Simulations:
    """Simulations at the start of a window, under psi of their own; see `replayed`."""
    ground, seed, hard = (window[f"terrain_{k}"][0].item() for k in ("kind", "seed", "difficulty"))
    maps = [made(machine.terrain_kinds[ground], seed, hard, machine.kind.terrain_scale)] if machine.rough else []
    sims = machine.simulations(len(u), nthread, maps)
    view = sims.view
    sims.begin(np.arange(len(u)), {"psi": machine.space.low + u * (machine.space.high - machine.space.low)})
    # Whatever of the task is in the states (a target, a goal) is the same for all psi.
    view.task.update({name: np.zeros_like(value) for name, value in view.task.items()})
    sims.batch.state[...] = window["start"]
    if off is not None and off.any():
        view.qvel[...] += starts.world(off, np.array(view.qpos[:, 3:7]))
        sims.batch.forward()
    view.now = sims.robot.derive(view)
    return sims


def _first(machine: Machine, window: Batch, u: Array, off: Array) -> Array:
    """(m, s) what is observed at the start, with velocities `off` (m, nv)."""
    sims = _begun(machine, window, np.tile(u, (len(off), 1)), 1, off)
    return np.concatenate(sims.robot.proprio(sims.view), -1)
