"""`View`: what a robot's laws read of one simulation or of a batch of them, in arrays with any leading batch shape."""

from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STATE = ("qpos", "qvel", "ctrl")


class View:
    """Live arrays of a simulation, B being () for the single environment and (n,) for the vector environment.

    Args:
      model: the nominal model: sizes, addresses, names. Per-simulation values of psi are not in it.
      fetch: name of an `MjData` field -> live array (*B, ...).
      reads: derived fields that the robot reads, besides the state.
      ground: see below.

    Attributes:
      qpos, qvel, ctrl: (*B, nq), (*B, nv), (*B, nu) float64, live.
      sensordata, xpos, ...: what `reads` names, (*B, ...), of the state before the last physics step, as `mj_step`
        leaves them (after a reset: of the state itself).
      task: the episode's memory (goal, clock, last action, ...), name -> (*B, ...). Never write into these arrays.
      now: what `Robot.derive` computed of the present state.
      before: the same, one control step earlier.
      ground: world points (*B, ..., 2) -> height of the terrain there, (*B, ...) m; a float for a single point.
    """

    qpos: Array
    qvel: Array
    ctrl: Array
    sensordata: Array

    def __init__(
        self,
        model: mujoco.MjModel,
        fetch: Callable[[str], NDArray],
        reads: Sequence[str],
        ground: Callable[[NDArray], Array | float],
    ) -> None:
        self.model = model
        self.ground = ground
        self.task: dict[str, NDArray] = {}
        self.now: Any = None
        self.before: Any = None
        self._fields = {name: fetch(name) for name in (*STATE, *reads)}
        self.__dict__.update(self._fields)

    def field(self, name: str) -> NDArray:
        """A field of `MjData` by name; only those in `reads` (and the state) are there."""
        return self._fields[name]

    def __getattr__(self, name: str) -> NDArray:
        known = self.__dict__.get("_fields", {})
        raise AttributeError(f"the view has no field {name!r}: name it in Robot.reads (there are: {', '.join(known)})")
