"""Effects at work in many simulations at once: each has its own, led by the stand-ins' own code one by one."""

import copy
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from standin.outside import Patch, parts

from nfc_gym.core.errors import InputError
from nfc_gym.measured.hidden import Hidden

# What a force may be a function of: fields of `MjData` that a scratch copy is given before it is asked.
READ = ("qpos", "qvel", "ctrl", "actuator_force", "xpos", "xmat", "xipos", "ximat", "xanchor", "xaxis", "cvel",
        "subtree_com", "geom_xpos", "geom_xmat", "time")  # fmt: skip


def overrides(hidden: Hidden, hook: str) -> bool:
    """Whether any of its parts has that hook."""
    return any(getattr(type(p), hook) is not getattr(Hidden, hook) for p in parts(hidden))


class Acting:
    """What the hidden effect of a vector environment does to commands and forces, physics step by physics step.

    Args:
      env: a vector environment on `mujoco.batch` with the hooks of `RobotVectorEnv`.
      hidden: the effect; each simulation gets a copy. What it does to the model must be in the environment's already.

    Effects that only shape the machine add no hook and cost nothing.
    """

    def __init__(self, env: Any, hidden: Hidden) -> None:
        if any(isinstance(p, Patch) for p in parts(hidden)):
            raise InputError("friction by place writes into one model, which many simulations share")
        self.commands, self.pushes = overrides(hidden, "command"), overrides(hidden, "push")
        if not (self.commands or self.pushes):
            return
        self.env, self.each = env, [copy.deepcopy(hidden) for _ in range(env.num_envs)]
        self.batch: Any = None
        env.reset_hooks.append(self._begin)
        env.control_hooks.append(self._commanded)
        env.substep_hooks.append(self._act)
        env.after_hooks.append(self._end)

    def _look(self) -> None:
        """Views of the batch; with other terrains an environment makes itself another one."""
        batch, model = self.env.batch, self.env.model
        self.batch, self.scratch = batch, mujoco.MjData(model)
        self.ctrl, self.sent = batch.bind("ctrl"), np.zeros((self.env.num_envs, model.nu))
        self.forces = [batch.bind(n) for n in ("qfrc_applied", "xfrc_applied")] if self.pushes else []
        self.seen = [(getattr(self.scratch, n, None), n, batch.bind(n)) for n in READ] if self.pushes else []

    def _begin(self, ids: NDArray[np.intp]) -> None:
        if self.env.batch is not self.batch:
            self._look()
        for i in ids:
            self.each[i].begin(self.env.model)

    def _commanded(self, _: Any) -> None:
        self.sent[...] = self.ctrl

    def _act(self, _: Any) -> None:
        if self.commands:
            for hidden, out, sent in zip(self.each, self.ctrl, self.sent, strict=True):
                out[:] = hidden.command(sent.copy())
        if self.pushes:
            for i, hidden in enumerate(self.each):
                self._push(i, hidden)

    def _push(self, i: int, hidden: Hidden) -> None:
        scratch, (along, outside) = self.scratch, self.forces
        for field, name, values in self.seen:
            if name == "time":
                scratch.time = values[i]
            else:
                field[...] = values[i].reshape(field.shape)
        scratch.qfrc_applied[:], scratch.xfrc_applied[:] = 0, 0
        hidden.push(scratch)
        along[i], outside[i] = scratch.qfrc_applied, scratch.xfrc_applied

    def _end(self, _: Any) -> None:
        for force in self.forces:
            force[...] = 0
