"""Parts of a trajectory, replayed from the states that were estimated at their starts."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nfc_gym.envs.simulations import Simulations
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.recorded import place
from nfc_gym.simulate.residuals import Given, Residuals
from nfc_gym.simulate.roll import step
from nfc_gym.terrain import Heightfield

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Segments:
    """Parts of a trajectory.

    Attributes:
      starts: (n, nq + nv), or with the actuators' states behind them (n, nq + nv + na).
      first, second, last: (n, s) `proprio` where they start, a control step later, and where they end.
      actions: (n, span, a).
      earlier: (n, EARLIER, a) the actions before; the first one of the trajectory stands for what came before it.
      maps: the ground underfoot, and others that it may as well be; none is a plane.
      hidden: the starts are made of `proprio` alone (`start.observed`).
    """

    starts: Array
    first: Array
    second: Array
    last: Array
    actions: Array
    earlier: Array
    maps: list[Heightfield] = field(default_factory=list)
    hidden: bool = False


def replayed(
    machine: Machine, sims: Simulations, starts: Array, first: Array, actions: Array, given: Sequence[Given] = (),
    earlier: Array | None = None,
) -> Array:  # fmt: skip
    """(n, s) `proprio` after the actions (n, span, a), from `Segments.starts`; nan where simulations come apart.

    Args:
      machine, sims: n simulations, in which an episode has begun.
      starts, first, actions, earlier: as `Segments` has them.
      given: effects at work in them.
    """
    sims.batch.reset(np.arange(sims.n), sims.rest)
    residuals = Residuals(sims, given)
    robot, view = sims.robot, sims.view
    view.task.update({name: np.zeros_like(value) for name, value in view.task.items()})
    place(machine, sims, starts, first)
    sims.batch.forward()
    view.now = robot.derive(view)
    for action in () if earlier is None else earlier.transpose(1, 0, 2):
        residuals.recall(robot.actuate(action, view), machine.kind.frame_skip)
    for action in actions.transpose(1, 0, 2):
        view.ctrl[...] = robot.actuate(action, view)
        residuals.command(view.ctrl)
        step(sims, ~residuals.between, machine.kind.frame_skip)
        for _ in range(machine.kind.frame_skip if residuals.parts else 0):
            residuals.act()
            step(sims, residuals.between, 1)
        residuals.rest()
        view.task.update(robot.advance(view, action))
        view.before, view.now = view.now, robot.derive(view)
    return np.concatenate(robot.proprio(view), -1)
