"""`Repeated`: one window's commands again and again, from other starts and under other psi.

A posterior need not be learned from windows of any motion when it is asked about one. What the robot was commanded is
known, and where the window began is known as far as its first observation tells. What psi does to *this* motion is a
far simpler thing than what it does to any.
"""

from dataclasses import dataclass, replace

import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.inference.space import PriorBox
from nfc_gym.inference.windows import Batch
from nfc_gym.simulate.draws import Array
from nfc_gym.simulate.likely import Likely
from nfc_gym.simulate.machine import Machine
from nfc_gym.simulate.opening import Opening
from nfc_gym.simulate.recorded import Recorded
from nfc_gym.simulate.rounds import Simulator

_APART = 1e-3  # m or 1, between starts that are not the same


@dataclass(frozen=True)
class Repeated:
    """Calls with (theta, seed) simulate the window once for each theta, and say how far it is off what was observed.

    theta is psi in the prior's probit coordinates, and the coordinates of the start (`Opening`).

    Attributes:
      simulator: how windows are made; what moves them is replaced.
      states: (H + 1, s) `proprio` of the window, as observed.
      actions: (H, a) as commanded.
      opening: where it may have begun.
    """

    simulator: Simulator
    states: Array
    actions: Array
    opening: Opening

    @classmethod
    def of(
        cls, simulator: Simulator, states: Array, actions: Array, windows: Batch, rng: np.random.Generator
    ) -> "Repeated":
        """Of a window on a plane.

        Args:
          simulator: of the robot.
          states: (n + 1, s), n at least H, of which the last H steps count.
          actions: (n, a).
          windows: of any motion, from which it is learned how starts go with what is observed there, as of
            `simulator.draw` with "states", "start" and "psi" among its names.
          rng: of draws of the start.

        Raises:
          InputError: rough ground, another robot's window or windows, too short, not finite, or too few windows.
        """
        machine = Machine(simulator.environment)
        states, actions = last_of(machine, states, actions)
        return cls(simulator, states, actions, Opening(Likely(machine, windows, states[0]), rng))

    @property
    def size(self) -> int:
        """Entries of theta."""
        return len(Machine(self.simulator.environment).space) + self.opening.size

    def __call__(self, theta: Array, seed: int) -> Array:
        """(n, H k) observed less simulated of what sensors tell (`Machine.told`), in units of their noise.

        What is simulated comes without that noise. Equal seeds give the motors equal noise. What comes apart is nan.

        Args:
          theta: (n, `size`).
          seed: of the motors' noise.
        """
        machine = Machine(self.simulator.environment)
        prior = PriorBox.of(machine.space, machine.kind.name)
        z = theta[:, : prior.size]
        starts = self.opening.starts(z, theta[:, prior.size :])
        again = replace(
            self.simulator, recorded=Recorded(starts, self.states[None], self.actions[None]), noise=0.0,
            names=("states", "pose"),
        )  # fmt: skip
        made = {k: t.numpy().astype(float) for k, t in again(prior.from_z(z), np.random.default_rng(seed)).items()}
        ends = made["states"][:, 1:]
        # A simulation that came apart was made again from another's start.
        ends[np.abs(made["pose"][:, 0] - starts[:, :7]).max(1) > _APART] = np.nan
        off = machine.difference(np.broadcast_to(self.states[1:], ends.shape).copy(), ends)
        return (off[..., machine.told] / (self.simulator.noise * machine.noise[machine.told])).reshape(len(theta), -1)


def last_of(machine: Machine, states: Array, actions: Array) -> tuple[Array, Array]:
    """(H + 1, s) states and (H, a) actions, the last of a window.

    Raises:
      InputError: another robot's, too short, or not finite.
    """
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
    return states, actions
