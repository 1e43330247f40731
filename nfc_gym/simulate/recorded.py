"""Motion that was recorded, to be simulated again under other psi: where it began, and what was commanded."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.envs.quadcopter import Quadcopter
from nfc_gym.envs.simulations import Simulations
from nfc_gym.simulate.machine import Machine
from nfc_gym.terrain import Heightfield

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Recorded:
    """Stretches of recorded motion, one window long each.

    Attributes:
      starts: (n, nq + nv) positions and velocities where they begin, or with the actuators' states behind them. Of one
        stretch there may be several, m: then window i begins at the i-th.
      states: (n, H+1, s) `proprio` as observed.
      actions: (n, H, a) as commanded.
      maps: the ground that they were recorded on; none is a plane.
      which: (n,) map of each stretch.
    """

    starts: Array
    states: Array
    actions: Array
    maps: tuple[Heightfield, ...] = ()
    which: NDArray[np.intp] | None = None

    def __len__(self) -> int:
        return len(self.starts)

    def require(self, machine: Machine) -> None:
        """Refuse motion that is not a robot's.

        Raises:
          InputError: there is none, it is of another robot or length, not finite, or lacks the ground.
        """
        n, h, kind, model = len(self.states), machine.habit.horizon, machine.kind, machine.model
        moving, starts = model.nq + model.nv, len(self) if n == 1 else n
        wanted = {
            "starts": {(starts, moving), (starts, moving + model.na)},
            "states": {(n, h + 1, kind.proprio_size)},
            "actions": {(n, h, kind.action_size)},
        }
        for name, shapes in wanted.items():
            value = getattr(self, name)
            if not n * starts or value.shape not in shapes or not np.isfinite(value).all():
                raise InputError(
                    f"recorded motion: {name} has shape {value.shape}; {machine.environment} wants finite {shapes}"
                )
        on = np.zeros(n, np.intp) if self.which is None else self.which
        inside = on.shape == (n,) and bool(((on >= 0) & (on < max(1, len(self.maps)))).all())
        if machine.rough != bool(self.maps) or not inside:
            raise InputError(
                f"recorded motion: {len(self.maps)} maps for {machine.environment}; want "
                f"{'some, and for each stretch the number of its own' if machine.rough else 'none'}"
            )

    def at(self, windows: NDArray[np.intp], drawn: NDArray[np.intp]) -> "Recorded":
        """What some windows repeat: stretches as drawn, 0 to n - 1, or the one that there is."""
        starts = windows % len(self) if len(self.states) == 1 else drawn
        rows = drawn if len(self.states) > 1 else np.zeros_like(drawn)
        which = None if self.which is None else self.which[rows]
        return Recorded(self.starts[starts], self.states[rows], self.actions[rows], self.maps, which)


def place(machine: Machine, sims: Simulations, starts: Array, first: Array) -> None:
    """Put simulations where robots were; `view.now` is left to the caller.

    Args:
      machine, sims: n simulations, in which an episode has begun.
      starts: (n, nq + nv) or (n, nq + nv + na), see `Recorded`.
      first: (n, s) `proprio` there, of which the goal is taken that a Quadcopter has.
    """
    view, nq, moving = sims.view, machine.model.nq, machine.model.nq + machine.model.nv
    view.qpos[...], view.qvel[...] = starts[:, :nq], starts[:, nq:moving]
    if starts.shape[1] > moving:
        sims.batch.bind("act")[...] = starts[:, moving:]
    if isinstance(sims.robot, Quadcopter):
        view.task["goal"] = starts[:, :3] + first[:, :3]
