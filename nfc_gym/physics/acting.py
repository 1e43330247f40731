"""`Acting`: effects at work in a running simulation, physics step by physics step.

The calibrator's roll-outs, the wrapper around one environment and the one around a vector environment run their effects
through this class, so that the same effect makes the same numbers in each.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.physics.effects.base import Context, Effect, Forces, overrides
from nfc_gym.physics.fields import ModelFields
from nfc_gym.physics.past import trace

Array = NDArray[np.float64]
_ANEW = object()  # in place of a hidden state that the next command settles


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

    Raises:
      InputError: an effect could do nothing, whatever its size.
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
        for effect in effects:
            effect.require_use(model, effects)
        pairs = list(zip(effects, thetas, strict=True))
        self.commanding = [(e, theta) for e, theta in pairs if overrides(e, "action")]
        self.rubbing = [(e, theta) for e, theta in pairs if overrides(e, "friction")]
        self.pushing = [(e, theta) for e, theta in pairs if overrides(e, "force")]
        self.varying = [(e, theta) for e, theta in pairs if overrides(e, "modulate")]
        self.tracking = [(e, theta) for e, theta in pairs if overrides(e, "follow")]
        self.acts = bool(self.rubbing or self.pushing or self.varying)
        self.memories: list[Any] = []
        self.traces: dict[Effect, Any] = {}
        self.derived: set[str] = set()
        self.nominal: dict[str, Array] = {}
        self.fresh: NDArray[np.bool_] | None = None
        self.shown: tuple[Context, Forces] | None = None
        self.loss = self.fields["dof_frictionloss"] if self.rubbing else np.zeros(0)
        self.base_friction = self.loss.copy()
        self.varied = {n: self.fields[n] for e, _ in self.varying for n in e.MODULATES}
        self.base = {n: live.copy() for n, live in self.varied.items()}

    def restart(self, rows: NDArray[np.bool_] | None = None) -> None:
        """Episodes begin, of all simulations or of the `rows` (n,): hidden states are settled by the next command.

        The model's fields as they are now become what the effects add to.
        """
        if rows is None or rows.all():
            self.memories.clear()
            self.traces.clear()
            self.derived.clear()
            rows = None
        self.fresh, self.shown = rows, None
        self.nominal.clear()
        if self.rubbing:
            self.loss = loss = self.fields["dof_frictionloss"]
            self.base_friction = loss.copy() if rows is None else np.where(rows[:, None], loss, self.base_friction)
        for name, base in self.base.items():
            self.varied[name] = live = self.fields[name]
            self.base[name] = live.copy() if rows is None else _merged(live, base, rows)

    def settle_quick(self) -> None:
        """Hidden states of commands begin anew with the next one, but for those that go on at any step (`span`)."""
        pairs = zip(self.memories, self.commanding, strict=False)
        self.memories = [m if e.span(theta) else _ANEW for m, (e, theta) in pairs]

    def command(
        self, ctrl: Array, exogenous: Mapping[str, Array], dt: float | None = None,
        serve: Callable[[Array], Array] | None = None,
    ) -> Array:  # fmt: skip
        """The command (..., nu) of a step after the effects on it; the first one settles their hidden states.

        Args:
          ctrl: (..., nu).
          exogenous: signals, (...,) each.
          dt: how long it is held, default a physics step.
          serve: what a firmware makes of goals (..., nu): the effects of a drive (`Effect.on_drive`) act behind it, all
            others before. Without it all act in their order.
        """
        dt = dt or self.dt
        slots = range(len(self.commanding))
        if serve is None:
            return self._affected(slots, ctrl, exogenous, dt)
        before, behind = ([k for k in slots if self.commanding[k][0].on_drive is on] for on in (False, True))
        return self._affected(behind, serve(self._affected(before, ctrl, exogenous, dt)), exogenous, dt)

    def _affected(self, slots: Iterable[int], ctrl: Array, exogenous: Mapping[str, Array], dt: float) -> Array:
        """Commands after some of the effects on them."""
        if not self.memories:
            self.memories = [_ANEW] * len(self.commanding)
        for slot in slots:
            effect, theta = self.commanding[slot]
            if self.memories[slot] is _ANEW:
                self.memories[slot] = effect.state0(ctrl.shape[:-1], ctrl, theta, dt)
            elif self.fresh is not None:
                settled = effect.state0(ctrl.shape[:-1], ctrl, theta, dt)
                self.memories[slot] = _merged(settled, self.memories[slot], self.fresh)
            ctrl, self.memories[slot] = effect.action(ctrl, theta, self.memories[slot], exogenous, dt)
        return ctrl

    def recall(
        self, q: Array, v: Array, ctrl: Array, exogenous: Mapping[str, Array], off: tuple[Array, Array] | None = None
    ) -> None:
        """A step of the measured past, (..., nq), (..., nv), (..., nu): only hidden states of forces go along.

        Args:
          off: (..., nq), (..., nv) by how much q and v are off for effects that ask for it (`Segments.off`).
        """
        measured = Context(self.model, self.dt, q, v, ctrl, exogenous, _unmeasured, self._nominal)
        moved = None if off is None else replace(measured, q=q + off[0], v=v + off[1])
        self._follow(measured, None, moved)

    def _follow(self, here: Context, fresh: NDArray[np.bool_] | None, moved: Context | None = None) -> None:
        """Hidden states of forces for the step that begins `here`, or at `moved` for effects that ask for that."""
        for effect, theta in self.tracking:
            ctx = moved if moved is not None and effect.off_before else here
            if effect not in self.traces:
                self.traces[effect] = effect.rest(ctx, theta)
            elif fresh is not None:
                self.traces[effect] = _merged(effect.rest(ctx, theta), self.traces[effect], fresh)
            self.traces[effect] = effect.follow(ctx, theta, self.traces[effect])

    def push(self, ctrl: Array, exogenous: Mapping[str, Array]) -> None:
        """Write the fields of the coming step and add its forces to what is applied already."""
        fresh, self.fresh = self.fresh, None
        if fresh is not None and self.derived:
            self.engine.forward(np.flatnonzero(fresh))
        if not self.acts:
            return
        ctx, out = self.shown or self._show(ctrl, exogenous)
        ctx.ctrl, ctx.exogenous = ctrl, exogenous
        if self.tracking:
            self._follow(ctx, fresh)
        self._apply(ctx, out)

    def push_along(self, ctrl: Array, exogenous: Mapping[str, Array], tracks: Sequence[NDArray[np.intp]]) -> None:
        """The same at N moments at once, of tracks that are known as a whole and that hidden states are led along.

        Args:
          ctrl: (N, nu).
          exogenous: signals, (N,) each.
          tracks: see `past.trace`.
        """
        ctx, out = self._show(ctrl, exogenous)
        self.traces = {effect: trace(effect, ctx, theta, tracks) for effect, theta in self.tracking}
        self._apply(ctx, out)

    def _apply(self, ctx: Context, out: Forces) -> None:
        """All that effects do to a step besides its command."""
        if self.rubbing:
            self.loss[...] = self.base_friction
            for effect, theta in self.rubbing:
                dofs, level = effect.friction(ctx, theta)
                self.loss[..., dofs] += level
        for name, live in self.varied.items():
            live[...] = self.base[name]
        for effect, theta in self.varying:
            ctx.memory = self.traces.get(effect)
            effect.modulate(ctx, theta, self.varied)
        for effect, theta in self.pushing:
            ctx.memory = self.traces.get(effect)
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
        """A model field; these arrays are live too, but for those that `push` writes to."""
        if name not in self.nominal:
            rubbed = self.rubbing and name == "dof_frictionloss"
            kept = self.base_friction if rubbed else self.base.get(name)
            self.nominal[name] = self.fields[name] if kept is None else kept
        return self.nominal[name]


def _unmeasured(name: str) -> Array:
    raise LookupError(f"a measured past has no {name}: `follow` reads q, v, ctrl and signals alone")


def _merged(new: Any, old: Any, rows: NDArray[np.bool_]) -> Any:
    """Hidden states with `rows` (n,) taken from `new` and the others from `old`.

    A list that has grown in one of them goes on as it ends in the other; what is no array belongs to all rows.
    """
    if isinstance(old, tuple):
        return tuple(_merged(a, b, rows) for a, b in zip(new, old, strict=True))
    if isinstance(old, list):
        count = max(len(new), len(old))
        ends = ([*part, *[part[-1]] * (count - len(part))] for part in (new, old))
        return [_merged(a, b, rows) for a, b in zip(*ends, strict=True)]
    if not isinstance(old, np.ndarray):
        return old
    return np.where(rows.reshape(-1, *(1,) * (np.ndim(old) - 1)), new, old)
