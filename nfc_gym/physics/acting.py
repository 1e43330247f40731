"""`Acting`: effects at work in a running simulation, physics step by physics step.

The calibrator's roll-outs, the wrapper around one environment and the one around a vector environment run their effects
through this class, so that the same effect makes the same numbers in each.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.physics.effects.base import Context, Effect, Forces, overrides
from nfc_gym.physics.fields import ModelFields

Array = NDArray[np.float64]


class Engine(Protocol):
    """The simulation that effects act in: a `mujoco.batch.Batch`, or what looks like one around an `MjData`.

    Attributes:
      qpos, qvel: (..., nq), (..., nv) the state.
      qfrc_applied, xfrc_applied: (..., nv), (..., nbody, 6), where forces go.
    """

    def bind(self, name: str) -> Array:
        """A live field of `MjData`."""
        ...

    def forward(self, ids: Any = None) -> None:
        """Recompute the derived fields for the state as it is, of all simulations or of some."""
        ...


class Acting:
    """Effects with their parameter values and hidden states.

    Args:
      model: the nominal model.
      effects: bound to `model`, in the order in which their hooks run.
      thetas: each effect's parameters (..., k).
      fields: the model fields of the simulation.
      engine: the simulation.
      dt: physics step, s.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        effects: Sequence[Effect],
        thetas: Sequence[Array],
        fields: ModelFields,
        engine: Engine,
        dt: float,
    ) -> None:
        self.model, self.fields, self.engine, self.dt = model, fields, engine, dt
        pairs = list(zip(effects, thetas, strict=True))
        self.commanding = [(e, theta) for e, theta in pairs if overrides(e, "action")]
        self.rubbing = [(e, theta) for e, theta in pairs if overrides(e, "friction")]
        self.pushing = [(e, theta) for e, theta in pairs if overrides(e, "force")]
        self.memories: list[Any] = []
        self.derived: set[str] = set()
        self.nominal: dict[str, Array] = {}
        self.fresh: NDArray[np.bool_] | None = None
        self.shown: tuple[Context, Forces] | None = None
        self.loss = self.fields["dof_frictionloss"] if self.rubbing else np.zeros(0)
        self.base_friction = self.loss.copy()

    def restart(self, rows: NDArray[np.bool_] | None = None) -> None:
        """Episodes begin, of all simulations or of the `rows` (n,): hidden states are settled by the next command.

        The model's dry friction as it is now becomes what the effects add to.
        """
        if rows is None or rows.all():
            self.memories.clear()
            self.derived.clear()
            rows = None
        self.fresh, self.shown = rows, None
        self.nominal.clear()
        if self.rubbing:
            self.loss = loss = self.fields["dof_frictionloss"]
            self.base_friction = loss.copy() if rows is None else np.where(rows[:, None], loss, self.base_friction)

    def command(self, ctrl: Array, exogenous: Mapping[str, Array]) -> Array:
        """The command (..., nu) of a step after the effects on it; the first one settles their hidden states."""
        for slot, (effect, theta) in enumerate(self.commanding):
            if len(self.memories) == slot:
                self.memories.append(effect.state0(ctrl.shape[:-1], ctrl, theta, self.dt))
            elif self.fresh is not None:
                settled = effect.state0(ctrl.shape[:-1], ctrl, theta, self.dt)
                self.memories[slot] = _merged(settled, self.memories[slot], self.fresh)
            ctrl, self.memories[slot] = effect.action(ctrl, theta, self.memories[slot], exogenous, self.dt)
        return ctrl

    def push(self, ctrl: Array, exogenous: Mapping[str, Array]) -> None:
        """Write the dry friction of the coming step and add its forces to what is applied already."""
        if self.fresh is not None:
            fresh, self.fresh = self.fresh, None
            if self.derived:
                self.engine.forward(np.flatnonzero(fresh))
        if not (self.rubbing or self.pushing):
            return
        ctx, out = self.shown or self._show(ctrl, exogenous)
        ctx.ctrl, ctx.exogenous = ctrl, exogenous
        if self.rubbing:
            self.loss[...] = self.base_friction
            for effect, theta in self.rubbing:
                dofs, level = effect.friction(ctx, theta)
                self.loss[..., dofs] += level
        for effect, theta in self.pushing:
            effect.force(ctx, theta, out)

    def _show(self, ctrl: Array, exogenous: Mapping[str, Array]) -> tuple[Context, Forces]:
        """What hooks read and where they write; the engine's arrays are live, and asked for once an episode."""
        engine = self.engine
        state = (engine.qpos, engine.qvel, ctrl)
        ctx = Context(self.model, self.dt, *state, exogenous, self._derived, self._nominal)
        self.shown = ctx, Forces(engine.qfrc_applied, engine.xfrc_applied)
        return self.shown

    def _derived(self, name: str) -> Array:
        """A field of `MjData`, computed for the state as it is where it is read for the first time.

        A batch fills a derived field from the first call after its binding on, and it is zero until then; an `MjData`
        holds what the commands of an earlier step made. `forward` leaves the solver's warm start alone.
        """
        array = self.engine.bind(name)
        if name not in self.derived:
            self.derived.add(name)
            self.engine.forward()
        return array

    def _nominal(self, name: str) -> Array:
        """A model field; these arrays are live too, but for the friction that `push` writes to."""
        if name not in self.nominal:
            rubbed = self.rubbing and name == "dof_frictionloss"
            self.nominal[name] = self.base_friction if rubbed else self.fields[name]
        return self.nominal[name]


def _merged(new: Any, old: Any, rows: NDArray[np.bool_]) -> Any:
    """Hidden states with `rows` (n,) taken from `new` and the others from `old`."""
    if isinstance(old, tuple | list):
        return type(old)(_merged(a, b, rows) for a, b in zip(new, old, strict=True))
    if old is None:
        return None
    return np.where(rows.reshape(-1, *(1,) * (np.ndim(old) - 1)), new, old)
