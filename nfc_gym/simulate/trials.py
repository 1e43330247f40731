"""Windows of machines that are given: psi as it is told, inside the prior's box or not, with one effect or none."""

import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.inference.windows import Batch
from nfc_gym.physics.effects import Effect
from nfc_gym.physics.quiet import no_warnings
from nfc_gym.simulate import ground, motion
from nfc_gym.simulate.draws import Array, picked
from nfc_gym.simulate.drive import channels
from nfc_gym.simulate.machine import MOTOR, Machine
from nfc_gym.simulate.residuals import Given
from nfc_gym.simulate.roll import Task, roll

_PATIENCE = 12  # attempts at the motion of a window


@no_warnings()  # windows that come apart are drawn anew
def trials(
    machine: Machine,
    psi: Array,
    seed: int,
    *,
    effect: Effect | None = None,
    theta: Array | None = None,
    motor: float = MOTOR,
    noise: float = 1.0,
    nthread: int = 1,
) -> Batch:
    """One window on a plane for each row of psi, with sensor noise.

    Args:
      machine: the robot, on a plane.
      psi: (n, d) physical units.
      seed: of motion and noise.
      effect, theta: of all windows, and its parameters (n, k).
      motor: standard deviation of the motors' noise.
      noise: what multiplies the robot's sensor noise.
      nthread: threads.

    Returns:
      `states` (m, H+1, s), noisy; `actions` (m, H, a); `psi` (m, d); `start` (m, nstate), free of noise; `delta_s`
      (m, s); `row` (m,), the row of psi. m is n less the windows whose episode ended early in every attempt: a fault
      may throw a robot at once.

    Raises:
      InputError: the machine stands on rough ground, or psi has another shape.
    """
    if machine.rough:
        raise InputError(f"trials: {machine.environment} is rough; want a Flat environment")
    psi = np.asarray(psi, float)
    if psi.ndim != 2 or psi.shape[1] != len(machine.space):
        raise InputError(f"trials: psi has shape {psi.shape}, want (n, {len(machine.space)})")
    rng = np.random.default_rng(seed)
    pending, parts = np.arange(len(psi)), []
    for _ in range(_PATIENCE):
        given = [] if effect is None or theta is None else [Given(effect, slice(0, len(pending)), theta[pending])]
        done = roll(machine, _task(machine, psi[pending], rng, motor, given), [], None, nthread)
        good = ~(done.unstable | done.ended)
        parts.append((pending[good], done.states[good], done.actions[good], done.start[good], done.delta_s[good]))
        pending = pending[~good]
        if not len(pending):
            break
    rows, states, actions, start, delta = (np.concatenate(p) for p in zip(*parts, strict=True))
    order = np.argsort(rows)
    states = states + noise * machine.noise * rng.standard_normal(states.shape)
    found = {"states": states, "actions": actions, "psi": psi[rows], "start": start, "delta_s": delta, "row": rows}
    return {name: value[order] for name, value in found.items()}


def _task(machine: Machine, psi: Array, rng: np.random.Generator, motor: float, given: list[Given]) -> Task:
    n, habit = len(psi), machine.habit
    low, high = habit.warm
    steps, wide = high + habit.horizon, channels(machine.settings.robot(machine.model))
    return Task(
        psi=psi,
        which=np.zeros(n, np.intp),
        start=rng.random((n, ground.count(machine))),
        signal=motion.signals(
            rng.random((n, motion.count(steps, wide))), steps, wide, machine.dt, habit.swing, habit.offset
        ),
        jitter=motor * rng.standard_normal((n, steps, machine.kind.action_size)),
        warm=low + picked(rng.random(n), high - low + 1),
        guided=np.zeros(n, bool),
        given=given,
    )
