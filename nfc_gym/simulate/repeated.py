"""`Repeated`: one window's commands again and again, under other psi, for rounds of inference about that window alone.

A posterior need not be learned from windows of any motion when it is asked about one. What the robot was commanded is
known, and where the window began is known as far as its first observation tells. Windows that share both differ by psi
and by noise alone, and what psi does to *this* motion is a far simpler thing to learn than what it does to any.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.inference.windows import Batch
from nfc_gym.simulate.draws import Array
from nfc_gym.simulate.likely import Likely
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.recorded import Recorded
from nfc_gym.simulate.rounds import Simulator


@dataclass(frozen=True)
class Repeated:
    """Calls with (psi, generator) simulate the window once for each psi.

    The first observation of each is the one that was made; the others come without the sensors' noise.

    Attributes:
      simulator: how windows are made; what moves them is replaced.
      states: (H + 1, s) `proprio` of the window, as observed.
      actions: (H, a) as commanded.
      begun: where it may have begun.
    """

    simulator: Simulator
    states: Array
    actions: Array
    begun: Likely

    @classmethod
    def of(cls, simulator: Simulator, states: Array, actions: Array, windows: Batch) -> "Repeated":
        """Of a window on a plane.

        Args:
          simulator: of the robot.
          states: (n + 1, s), n at least H, of which the last H steps count.
          actions: (n, a).
          windows: of any motion, from which it is learned how starts go with what is observed there, as of
            `simulator.draw` with "states", "start" and "psi" among its names.

        Raises:
          InputError: rough ground, another robot's window or windows, too short, not finite, or too few windows.
        """
        machine = Machine(simulator.environment)
        h = machine.habit.horizon
        states, actions = np.asarray(states, float), np.asarray(actions, float)
        wanted = (machine.kind.proprio_size, machine.kind.action_size)
        if states.ndim != 2 or actions.ndim != 2 or (states.shape[1], actions.shape[1]) != wanted or len(actions) < h:
            raise InputError(
                f"repeated: states {states.shape} and actions {actions.shape}; {machine.environment} wants "
                f"({h + 1} or more, {wanted[0]}) and ({h} or more, {wanted[1]})"
            )
        states, actions = states[-h - 1 :], actions[-h:]
        if not (np.isfinite(states).all() and np.isfinite(actions).all()):
            raise InputError("repeated: the window has entries that are not finite")
        return cls(simulator, states, actions, Likely(machine, windows, states[0]))

    @property
    def noise(self) -> Array:
        """(H + 1, s) standard deviation of what the sensors would add."""
        noise = np.tile(Machine(self.simulator.environment).noise * self.simulator.noise, (len(self.states), 1))
        noise[0] = 0  # the first observation has been made
        return noise

    def __call__(self, psi: Array, rng: np.random.Generator) -> dict[str, Any]:
        """As of `Simulator.__call__`."""
        space = Machine(self.simulator.environment).space
        u = (np.asarray(psi, float) - space.low) / (space.high - space.low)
        motion = Recorded(self.begun.draw(u, rng), self.states[None], self.actions[None])
        batch = replace(self.simulator, recorded=motion, noise=0.0)(psi, rng)
        batch["states"][:, 0] = batch["states"].new_tensor(self.states[0])
        return batch
