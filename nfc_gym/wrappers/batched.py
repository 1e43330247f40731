"""The physics beneath a vector environment on `mujoco.batch`, as the wrappers around it share it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.fields import ModelFields
from nfc_gym.wrappers.hooks import Hooks
from nfc_gym.wrappers.simulation_base import ATTRIBUTE, Simulation

Array = NDArray[np.float64]
_HOOKS = ("control_hooks", "substep_hooks", "after_hooks", "reset_hooks", "edit_hooks")


class BatchSimulation(Simulation):
    """The simulations of a vector environment on `mujoco.batch` with hooks at physics steps and resets.

    Attributes:
      on_reset: called with the ids (k,) of the simulations about to begin an episode; may return their reset options.
    """

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.shape = (int(env.num_envs),)
        self.pending = np.ones(self.shape, bool)
        self.started = np.ones(self.shape, bool)
        self.on_reset = Hooks()
        self._bound: set[str] = set()
        self._look()
        env.reset_hooks.append(self._resetting)
        env.edit_hooks.append(self.apply)

    def _look(self) -> None:
        """Views of the batch; with other terrains an environment makes itself another one."""
        env = self.env
        self.batch, self.fields = env.batch, env.fields
        self.nominal = self.fields.nominal_model
        batch = self.batch
        self.qpos, self.qvel, self.ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
        self.qfrc_applied, self.xfrc_applied = batch.bind("qfrc_applied"), batch.bind("xfrc_applied")
        self._held = (np.zeros_like(self.qfrc_applied), np.zeros_like(self.xfrc_applied))
        self.commanded = np.array(self.ctrl)
        for name in self._bound:
            batch.bind(name)

    @property
    def beginning(self) -> NDArray[np.bool_]:
        """(n,) which simulations wait for the first control step of an episode."""
        return self.pending

    def look_again(self) -> bool:
        """Whether the environment has another batch than before, which is then looked at."""
        if self.env.batch is self.batch:
            return False
        self._look()
        return True

    def bind(self, name: str) -> Array:
        """See `Simulation`; a field is filled from the first call after its first binding on."""
        self._bound.add(name)
        return self.batch.bind(name)

    def forward(self, ids: NDArray[np.intp] | None = None) -> None:
        """See `Simulation`."""
        self.batch.forward(ids)

    def _resetting(self, ids: NDArray[np.intp]) -> dict[str, Any]:
        """Rows are about to begin an episode: the options of the wrappers for them."""
        self.look_again()
        self.pending[ids] = True
        options: dict[str, Any] = {}
        self.refresh()
        for hook in self.on_reset.live():
            options |= hook(ids) or {}
        return options

    def fields_of(self, ids: NDArray[np.intp]) -> ModelFields:
        """Model fields of some simulations, ascending ids."""
        return self.fields if len(ids) == self.shape[0] else self.fields.rows(ids)

    def attach(self, who: str, after: bool = False, substeps: bool = True) -> None:
        """See `SingleSimulation`; these environments have a place for every hook."""
        if not self.attached:
            self.env.control_hooks.append(lambda _: self._begin())
            self.env.after_hooks.append(lambda _: self._end())
        if substeps and not self.between:
            self.env.substep_hooks.append(self._act)
            self.between = True
        self.attached = True

    def _act(self, _: Any) -> None:
        for hook in self.on_substep:
            hook()

    def _begin(self) -> None:
        self.started, self.pending = self.pending, np.zeros(self.shape, bool)
        self.commanded = np.array(self.ctrl)
        for hook in self.on_control:
            hook()
        if self.pushed and self.on_substep:
            self._held[0][...] = self.qfrc_applied
            self._held[1][...] = self.xfrc_applied

    def restore_forces(self) -> None:
        """See `SingleSimulation`."""
        self.qfrc_applied[...], self.xfrc_applied[...] = self._held

    def _end(self) -> None:
        if self.pushed:
            self.qfrc_applied[...] = 0
            self.xfrc_applied[...] = 0
        for hook in self.on_after:
            hook()


def batch_simulation_of(env: Any, who: str) -> BatchSimulation:
    """The simulations beneath a vector environment, the same object for all its wrappers.

    Raises:
      InputError: the vector environment does not run on `mujoco.batch`, as this package's own do.
    """
    base = env.unwrapped
    known = vars(base).get(ATTRIBUTE)
    if isinstance(known, BatchSimulation):
        return known
    lacking = [n for n in (*_HOOKS, "batch", "fields") if not hasattr(base, n)]
    if lacking:
        raise InputError(
            f"Vector{who} acts in the physics of a vector environment on mujoco.batch, as gymnasium.make_vec makes of "
            f"this package's ids; {type(base).__name__} lacks {', '.join(lacking)}. Put {who} around each single one: "
            f"make_vec(..., vectorization_mode='sync', wrappers=[...])"
        )
    made = BatchSimulation(base)
    setattr(base, ATTRIBUTE, made)
    return made
