"""What the physics beneath an environment is to the wrappers around it: one simulation, or a batch of them.

All wrappers of one environment meet in one `Simulation`: model edits start from the same nominal model, forces add up,
and whoever acts at each physics step is called there in the order in which the wrappers were put on, innermost first.
`simulation` makes it of one environment, `batched` of a vector environment.
"""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.fields import ModelFields
from nfc_gym.wrappers.hooks import Hooks, refresh

Array = NDArray[np.float64]
ATTRIBUTE = "_nfc_simulation"  # of an unwrapped environment


def _nothing() -> None:
    """What a simulation of many is pickled as: its wrappers make it anew."""


class Simulation:
    """State, model fields and hooks of one `MjData`, or of a batch of simulations.

    Attributes:
      env: the unwrapped environment.
      fields, nominal: model fields that edits go through, and the model that they start from.
      shape: leading batch shape, () or (n,).
      commanded: (..., nu) what the environment sent to the actuators in this control step, before any effect.
      started: which simulations are in the first control step of an episode: a bool, or (n,) bool.
      pushed: whether any hook applies forces, which are then taken back after each control step.
      late_ground: whether it is the first action of an episode that says on what ground it runs.
      on_control: called once a control step, before its first physics step.
      on_substep: called before every physics step.
      on_after: called after the last physics step of a control step, before anything is observed.
      edits: called with `ModelFields` at an episode's beginning, psi's with rank 0, effects' with rank 1.
      senses: (channel, values (T, k), interval in s) -> what the channel's sensor reports.
    """

    shape: tuple[int, ...] = ()
    fields: ModelFields
    nominal: mujoco.MjModel
    started: bool | NDArray[np.bool_]
    qpos: Array
    qvel: Array
    ctrl: Array
    qfrc_applied: Array
    xfrc_applied: Array

    def __init__(self, env: Any) -> None:
        self.env = env
        self.on_control, self.on_substep, self.on_after = Hooks(), Hooks(), Hooks()
        self.edits, self.senses = Hooks(), Hooks()
        self.commanded = np.zeros(0)
        self.pushed = self.late_ground = False
        self.attached = self.between = False

    def refresh(self) -> None:
        """Forget the hooks of wrappers that are gone."""
        refresh(self.on_control, self.on_substep, self.on_after)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return _nothing, ()

    @property
    def model(self) -> mujoco.MjModel:
        """The model that is simulated."""
        return self.env.model

    def apply(self, fields: ModelFields) -> int:
        """Every wrapper's edits, psi's first, to be committed; returns how many there are.

        Args:
          fields: of the model, or of those simulations of the batch that begin an episode.
        """
        edits = self.edits.live()
        for edit in edits:
            edit(fields)
        return len(edits)

    def bind(self, name: str) -> Array:
        """A live field of `MjData`, (..., *shape)."""
        raise NotImplementedError

    def forward(self, ids: Any = None) -> None:
        """Recompute the derived fields for the state as it is."""
        raise NotImplementedError

    def attach(self, who: str, after: bool = False, substeps: bool = True) -> None:
        """Make sure that the hooks are called: those before a control step, after it, and at physics steps."""
        raise NotImplementedError

    def restore_forces(self) -> None:
        """Applied forces as they were after the last `on_control`: what a substep's own forces are added to."""
        raise NotImplementedError

    def duration(self) -> float:
        """Length of a control step, s."""
        env = self.env
        skip = getattr(env, "frame_skip", None) or getattr(self.owner, "frame_skip", None)
        if not skip:
            raise InputError(f"{type(env).__name__} does not say its `frame_skip`: its control step is unknown")
        return float(self.model.opt.timestep) * int(skip)

    @property
    def owner(self) -> Any:
        """The object that steps the model: the environment, or the `MujocoEnv` that it holds."""
        return self.env
