"""The physics beneath one environment, as the wrappers around it share it.

What their hooks need is a place between two physics steps. An environment that keeps lists called `substep_hooks` and
`after_hooks` offers it itself, and one called `control_hooks` lets a control step in which nothing acts between two
physics steps stay one call; Gymnasium's `MujocoEnv` (and whatever holds one, as the mazes of gymnasium-robotics do)
is stepped here in place of its own `_step_mujoco_simulation`.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from nfc_gym.core.errors import InputError
from nfc_gym.physics.fields import ModelFields
from nfc_gym.wrappers.simulation_base import ATTRIBUTE, Array, Simulation
from nfc_gym.wrappers.stepping import Stepped, stepper_of


@dataclass(frozen=True)
class _Left:
    """What a simulation is pickled as: its wrappers make it anew, and from where it began, not from what they edited.

    Attributes:
      nominal: the model before any edit; None where the environment itself goes back to nominal.
      touched: fields that were edited.
    """

    nominal: mujoco.MjModel | None
    touched: tuple[str, ...]


class _Hook:
    """A method of a simulation in a list of an environment's hooks; in a copy of the environment it does nothing."""

    def __init__(self, method: Callable[[], None]) -> None:
        self.method = method

    def __call__(self, _: Any) -> None:
        self.method()

    def __reduce__(self) -> tuple[Callable[[], Callable[[Any], None]], tuple[()]]:
        return _no_hook, ()


def _idle(_: Any) -> None:
    """A hook that was copied without its simulation."""


def _no_hook() -> Callable[[Any], None]:
    return _idle


class SingleSimulation(Simulation):
    """One environment with `model` and `data`.

    An environment with `fields` (a `ModelFields` of its model, brought back to nominal at each of its resets) and
    `edit_hooks`, which it calls with them there, has its own psi, and every reset of it asks for the edits on top. Any
    other's model is edited right before.
    """

    def __init__(self, env: Any, left: _Left | None = None) -> None:
        super().__init__(env)
        own, nominal = getattr(env, "fields", None), left.nominal if left else None
        self.own_fields = isinstance(own, ModelFields) and hasattr(env, "edit_hooks")
        self.fields = own if self.own_fields else ModelFields(env.model, nominal or copy.copy(env.model))
        self.nominal = self.fields.nominal_model
        if left is not None and nominal is not None:
            for name in left.touched:
                self.fields[name]
            self.fields.restore()
            self.fields.commit()
        self._steps: tuple[Any, str] | None = stepper_of(env)
        if self.own_fields:
            env.edit_hooks.append(self.apply)
        self._inside = False
        self._calls = self._written = 0
        self._time = np.inf
        self.started = True
        self._look()

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return _Left, (None, ()) if self.own_fields else (self.nominal, tuple(self.fields.touched))

    @property
    def owner(self) -> Any:
        """See `Simulation`."""
        return self._steps[0] if self._steps else self.env

    def _look(self) -> None:
        """Views of the state; an environment may make itself another `MjData`."""
        data = self.env.data
        self.data = data
        self.qpos, self.qvel, self.ctrl = data.qpos, data.qvel, data.ctrl
        self.qfrc_applied, self.xfrc_applied = data.qfrc_applied, data.xfrc_applied
        self._base = (self.qfrc_applied.copy(), self.xfrc_applied.copy())
        self._held = (self.qfrc_applied.copy(), self.xfrc_applied.copy())

    def bind(self, name: str) -> Array:
        """See `Simulation`."""
        return getattr(self.data, name)

    def forward(self, ids: Any = None) -> None:
        """See `Simulation`."""
        mujoco.mj_forward(self.env.model, self.data)

    # ---- model edits ----------------------------------------------------------------------------------------------

    def edit(self) -> None:
        """Before a reset of a model that no environment brings back to nominal: nominal, with every wrapper's edits."""
        if not self.own_fields:
            self.fields.restore()
            self._written = self.apply(self.fields)
            self.fields.commit()

    def edit_again(self) -> None:
        """In an episode that has not moved yet: nominal, with psi and every edit; derived quantities follow."""
        self.fields.restore()
        if self.own_fields:
            self.env.psi_space.write(self.fields, self.env.psi)
        self.apply(self.fields)
        self.fields.commit()
        self.forward()

    # ---- stepping -------------------------------------------------------------------------------------------------

    def attach(self, who: str, after: bool = False, substeps: bool = True) -> None:
        """Make sure that the hooks are called.

        Args:
          who: for errors.
          after: `on_after` is needed too.
          substeps: `on_substep` is needed too.

        Raises:
          InputError: the environment steps its model where no such hook can be put.
        """
        owner, how = self._steps or (self.env, "")
        if not how or (after and how == "substep_hooks" and not hasattr(owner, "after_hooks")):
            place = "after the last physics step" if how else "between physics steps"
            raise InputError(
                f"{who} acts {place}, and {type(self.env).__name__} has no place for that: it needs `substep_hooks` "
                "and `after_hooks`, lists of callables that it calls with itself before every mj_step and after "
                "a control step's last, or to be stepped by gymnasium's MujocoEnv"
            )
        own = how == "substep_hooks"
        whole = own and hasattr(owner, "control_hooks")
        if not self.attached and not own:
            setattr(owner, how, Stepped(owner, how, self))
        if not self.attached and whole:
            _put(owner.control_hooks, self._begin)
        if not self.attached and hasattr(owner, "after_hooks"):
            _put(owner.after_hooks, self._end)
        if own and not self.between and (substeps or not whole):
            _put(owner.substep_hooks, self._act if whole else self._called)
            self.between = True
        self.attached = True

    def kept(self, edits: bool = False) -> Callable[[], None]:
        """What puts the running episode back after a reset that fails.

        Args:
          edits: made for that reset, to be made again as they were.
        """
        before = {name: self.__dict__[name] for name in ("started", "_inside", "_calls", "_time")}

        def undo() -> None:
            self.__dict__.update(before)
            if edits:
                self.edit()

        return undo

    def begin_episode(self) -> None:
        """The next control step is the first of an episode."""
        self.started = True
        self.refresh()
        if len(self.edits.live()) < self._written:  # a wrapper that edited the model is gone
            self.edit()
        self._inside, self._calls, self._time = False, 0, np.inf

    def _begin(self) -> None:
        """Before the first physics step of a control step; `ctrl` is set."""
        if self._inside:  # nobody said that the last control step is over
            self._end()
        data = self.env.data
        if data is not self.data:
            self._look()
        if data.time < self._time and not self.started:  # the clock of an episode that whomever beneath went back to
            self.started = True
            self.edit()
        self.commanded = self.ctrl.copy()
        if self.pushed:
            self._base[0][...], self._base[1][...] = self.qfrc_applied, self.xfrc_applied
        if self.started:
            self.refresh()
        for hook in self.on_control:
            hook()
        self.started, self._inside = False, True
        if self.pushed and self.on_substep:
            self._held[0][...], self._held[1][...] = self.qfrc_applied, self.xfrc_applied

    def restore_forces(self) -> None:
        """See `Simulation`."""
        self.qfrc_applied[...], self.xfrc_applied[...] = self._held

    def _end(self) -> None:
        if self.pushed:
            self.qfrc_applied[...], self.xfrc_applied[...] = self._base
        for hook in self.on_after:
            hook()
        self._time = self.data.time
        self._inside = False

    def _act(self) -> None:
        """Before a physics step of an environment that has hooks of its own."""
        for hook in self.on_substep:
            hook()

    def _called(self) -> None:
        """The same where the environment does not say which physics step is a control step's first."""
        if self._calls == 0:
            self._begin()
        self._calls = (self._calls + 1) % int(self.owner.frame_skip)
        self._act()

    def run(self, original: Callable[..., None], plain: bool, ctrl: Array, frames: int) -> None:
        """A control step in place of `MujocoEnv._step_mujoco_simulation`."""
        self.env.data.ctrl[:] = ctrl
        self._begin()
        if not self.on_substep:
            original(self.commanded, frames)
        else:
            model, data, hooks = self.env.model, self.data, self.on_substep
            for _ in range(frames):
                for hook in hooks:
                    hook()
                if plain:
                    mujoco.mj_step(model, data)
                else:
                    original(self.ctrl.copy(), 1)
            if plain:  # as the original does after its steps
                mujoco.mj_rnePostConstraint(model, data)
        self._end()


def _put(hooks: list[Any], method: Callable[[], None]) -> None:
    """Add a hook; those of the environment that this one was copied from go."""
    hooks[:] = [hook for hook in hooks if hook is not _idle] + [_Hook(method)]


def simulation_of(env: Any, who: str) -> SingleSimulation:
    """The simulation beneath an environment, the same one for all its wrappers.

    Raises:
      InputError: the environment has no MuJoCo model and data.
    """
    base = env.unwrapped
    known = vars(base).get(ATTRIBUTE)
    if isinstance(known, SingleSimulation):
        return known
    model, data = getattr(base, "model", None), getattr(base, "data", None)
    if not isinstance(model, mujoco.MjModel) or not isinstance(data, mujoco.MjData):
        raise InputError(
            f"{who} needs a MuJoCo environment: {type(base).__name__} has no `unwrapped.model` (mujoco.MjModel) and "
            "`unwrapped.data` (mujoco.MjData)"
        )
    made = SingleSimulation(base, known if isinstance(known, _Left) else None)
    setattr(base, ATTRIBUTE, made)
    return made
