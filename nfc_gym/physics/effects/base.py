"""`Effect`: one physical effect that a model may lack.

The same object is calibrated, wrapped around an environment, saved beside a model and named in a report. It acts
through one or more hooks. Every hook is a pure function over arrays with any leading batch shape `...`; `theta` is
(..., k), the effect's parameters in the order of `params`. In one physics step hooks run in this order: `action` on the
command, `model` (once, at set-up), `follow`, `friction`, `modulate` and `force` on the state before the step, `sense`
on what is measured.

What a joint went through before (a spring that yielded, a rotor within its play) is kept by `rest` and `follow`, and
`force` and `modulate` find it in `Context.memory`. Where logs tell how the joints moved before a segment starts,
`follow` is led along that motion first; elsewhere it begins from `rest`, as it does at an episode's reset.

At its null value an effect leaves the simulator's result unchanged bit for bit, by arithmetic and not by skipping it.
"""

from abc import ABC
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.lookup import Rows
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.effects.words import together, with_spread
from nfc_gym.physics.fields import ModelFields

Array = NDArray[np.float64]
TIME = "exo:time"  # seconds since the log, or the episode, began: a signal that every log has


@dataclass(frozen=True)
class Scales:
    """Typical magnitudes along the logs at hand, from which effects take realistic sizes.

    Attributes:
      force: (nv,) generalised force, N or N m.
      speed: (nv,) speed of each degree of freedom, m/s or rad/s.
      command: (nu,) spread of each command, in its own unit; of a firmware servo's goal.
      actuation: (nu,) force of each actuator, in its own unit.
      interval: median time between samples, s.
      exogenous: names of the exogenous signals that the logs carry, with their median value.
      channels: names of the measured channels, with (spread, noise) of each.
      low, high: (nq,) bounds of the motion's coordinates, None where unknown.
      push: (nv,) force of its actuators that each degree of freedom is known to have seen at most, 0 or None where
        nothing is known.
      served: (nu,) spread of what firmware servos make of their goals, None where there are no such servos.
    """

    force: Array
    speed: Array
    command: Array
    actuation: Array
    interval: float
    exogenous: Mapping[str, float] = field(default_factory=dict)
    channels: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    low: Array | None = None
    high: Array | None = None
    push: Array | None = None
    served: Array | None = None

    @property
    def drive(self) -> Array:
        """(nu,) spread of what reaches each drive."""
        return self.command if self.served is None else self.served


@dataclass
class Context:
    """What a hook may read of a simulation before a physics step; arrays share the leading batch shape.

    Attributes:
      model: the nominal model (sizes, addresses, names), never edited.
      dt: physics step, s.
      q, v: (..., nq), (..., nv) the state.
      ctrl: (..., nu) the command as it reaches the actuators.
      exogenous: measured signals by name, (...,).
      data: derived field of `MjData` by name, (..., *shape), one substep behind the state as after `mj_step`.
      nominal: a model field of the simulation before any per-step hook wrote to it, (..., *shape).
      memory: hidden state of the effect whose `force` or `modulate` is called, as its `follow` made it for this step.
      scratch: by effect, what its `modulate` found that its `force` needs in the same step.
    """

    model: mujoco.MjModel
    dt: float
    q: Array
    v: Array
    ctrl: Array
    exogenous: Mapping[str, Array]
    data: Callable[[str], Array]
    nominal: Callable[[str], Array]
    memory: Any = None
    scratch: dict[Any, Any] = field(default_factory=dict)


@dataclass
class Forces:
    """Where `force` hooks add: generalised forces (..., nv); world-frame body wrenches (..., nbody, 6) at the com."""

    qfrc: Array
    xfrc: Array


class Effect(ABC):
    """Base class: identity, parameters, and hooks that do nothing.

    Args:
      where: names of the model that it acts on.
      params: overrides the family's parameters (probing sizes are matched to the machine by `propose`).
    """

    family: ClassVar[str]
    summary: ClassVar[str]
    # What a reader of the library should know besides: numbers of the law that no parameter sets.
    remark: ClassVar[str] = ""
    # A member of the generic alternatives takes part in every contest but is never claimed by name.
    generic: ClassVar[bool] = False
    # Whether it acts in some places of the world, or at some times, alone, so that medians over all of a log hide what
    # it leaves.
    patchy: ClassVar[bool] = False
    # Of a generic alternative, whether it acts where no law in words pushes: under wheels and feet, inside a body.
    wordless: ClassVar[bool] = False
    # Families that together do the same at the same place unless this law's own feature shows; else claimed instead.
    simpler: ClassVar[tuple[tuple[str, ...], ...]] = ()
    # Families that are special cases of this law at the same place: beside them it is no further alternative.
    covers: ClassVar[tuple[str, ...]] = ()
    # Families that do nearly the same at the same place once psi takes up the rest: asked before this law is believed.
    kin: ClassVar[tuple[str, ...]] = ()
    # Whether values of its own at each of several places make sense.
    divisible: ClassVar[bool] = True
    # Whether its force follows those that the actuators make of commands (`actuator_force`). Inverse problems, which
    # know only what a motion needs of them, cannot show it.
    driven: ClassVar[bool] = False
    # Whether it sits at one place alone, and not with the same values at several.
    lone: ClassVar[bool] = False
    # Whether a place that is named twice says something.
    repeats: ClassVar[bool] = False
    # Whether it may sit on a ball joint, and then acts alike along all three of its degrees of freedom.
    BALLS: ClassVar[bool] = False
    # Attributes that `propose` sets and no parameter holds, each a text or a number: saved effects keep them.
    SETTINGS: ClassVar[tuple[str, ...]] = ()
    # Model fields that `modulate` writes to.
    MODULATES: ClassVar[tuple[str, ...]] = ()
    # Of an effect on commands: whether it is the drive's, behind a firmware servo, and not on the way of its goal.
    on_drive: ClassVar[bool] = False
    # Of an effect that remembers motion: whether a start's noise is that of what came before it, too (`Segments.off`).
    off_before: ClassVar[bool] = False
    # The family's parameters with wide bounds; `propose` matches bounds and probing sizes to the machine.
    PARAMS: ClassVar[tuple[Param, ...]] = ()
    # Of an effect at several places: the same at each of them alone, with bounds and sizes that fit that place.
    singles: "tuple[Effect, ...]" = ()

    def __init__(self, where: Sequence[str], params: Sequence[Param] | None = None) -> None:
        self.where: tuple[str, ...] = (where,) if isinstance(where, str) else tuple(where)
        self.params = self.PARAMS if params is None else tuple(params)

    @property
    def place(self) -> str:
        """The place in an id: one name, or names joined by `+`."""
        return "+".join(self.where)

    @property
    def id(self) -> str:
        """`family:place`."""
        return f"{self.family}:{self.place}"

    def __repr__(self) -> str:
        return f"<{self.id}>"

    @property
    def null(self) -> Array:
        """(k,) parameters at which nothing changes; shape parameters take their first probe."""
        return np.array([p.probes[0] if p.shape else p.null for p in self.params], float)

    @property
    def low(self) -> Array:
        """(k,) lower bounds."""
        return np.array([p.low for p in self.params], float)

    @property
    def high(self) -> Array:
        """(k,) upper bounds."""
        return np.array([p.high for p in self.params], float)

    @property
    def signals(self) -> tuple[str, ...]:
        """Exogenous signals that the effect reads."""
        return ()

    @property
    def settings(self) -> dict[str, Any]:
        """What `SETTINGS` names, by name."""
        return {name: getattr(self, name) for name in self.SETTINGS}

    @property
    def on_command(self) -> bool:
        """Whether it changes what reaches the actuators, and not what they make of it."""
        return overrides(self, "action")

    def known_as(self, theta: Array) -> tuple[str, ...]:
        """Families that are this very law by another name at the same place, at these parameters (k,)."""
        return ()

    @classmethod
    def propose(cls, model: mujoco.MjModel, scales: Scales) -> "list[Effect]":
        """Every place of a model where the effect could sit, with sizes that fit the machine."""
        raise NotImplementedError

    @classmethod
    def asked(cls, model: mujoco.MjModel, scales: Scales) -> "list[Effect]":
        """What is proposed where nothing else of a family is, and only of a family that was asked for by name."""
        return []

    @classmethod
    def declare(cls, names: Sequence[str]) -> tuple[Param, ...]:
        """The family's parameters of those names, in its own order; others raise `InputError`."""
        known = [p.name for p in cls.PARAMS]
        if set(names) != set(known):
            told = ", ".join(p.bounds for p in cls.PARAMS)
            raise InputError(
                f"{cls.family} has the parameters {told}, got: {', '.join(names) or 'none'} (in brackets the bounds of "
                "a fit)"
            )
        return cls.PARAMS

    def bind(self, model: mujoco.MjModel) -> None:  # noqa: B027 (most effects need no more than names)
        """Resolve names to addresses once; a name that the model lacks raises `InputError`."""

    def require_possible(self, theta: Array) -> None:
        """Refuse parameters (k,) that are not finite, or that no machine can have.

        Raises:
          InputError: naming the parameter and what it can be.
        """
        for p, value in zip(self.params, theta, strict=True):
            if not np.isfinite(value):
                raise InputError(f"effect {self.id!r}: {p.name} is {value:g}; it must be a finite number")
            if not p.possible(value):
                unit = "" if p.unit == "1" else f" {p.unit}"
                raise InputError(
                    f"effect {self.id!r}: {p.name} is {value:g}{unit}; it must be {p.wanted} "
                    f"(a fit goes from {p.low:g} to {p.high:g})"
                )

    def require_use(self, model: mujoco.MjModel, beside: Sequence["Effect"]) -> None:  # noqa: B027
        """Refuse an effect that could do nothing in a model, whatever its size, beside the other effects on it."""

    # ---- hooks ----------------------------------------------------------------------------------------------------

    def spec(self, spec: mujoco.MjSpec, theta: Array) -> bool:
        """Structural edit that lets plain MJCF carry the effect; returns whether it now does. theta (k,).

        An effect on commands (`on_command`) acts before all that the spec makes of a command already, so that of
        several the last goes first; every other acts after what the spec says already. Of a bound effect.
        """
        return False

    def marks(self, model: mujoco.MjModel) -> dict[str, Array]:
        """Numbers of the nominal model that `bind` wants and a corrected one no longer says: by name, (n,) each.

        Where the effect stays outside of a model that is saved, they go along in it as `numeric` elements.
        """
        return {}

    def model(self, fields: ModelFields, theta: Array) -> None:  # noqa: B027 (a hook: does nothing by design)
        """Edit model fields in place, starting from what is there (nominal, or psi's value)."""

    def state0(self, shape: tuple[int, ...], ctrl: Array, theta: Array, dt: float) -> Any:
        """Hidden state before the first command; `ctrl` (..., nu) is that command, held since ever."""
        return None

    def span(self, theta: Array) -> float:
        """Seconds of past commands that the hidden state of `action` depends on, of a state that goes on at any step.

        Where it is longer than the history before a segment, the state is led there through the commands before it, in
        coarse steps. 0 of a state that must begin anew where steps get another length.
        """
        return 0.0

    def action(
        self, ctrl: Array, theta: Array, memory: Any, exogenous: Mapping[str, Array], dt: float
    ) -> tuple[Array, Any]:
        """Command (..., nu) -> what the actuators receive, and the new hidden state."""
        return ctrl, memory

    def course(self, ctrl: Array, theta: Array, exogenous: Mapping[str, Array], dt: float) -> Array:
        """What `action` makes of a whole course of commands (..., T, nu) in steps of dt, settled at the first.

        theta is (..., k), signals are (..., T). A law with a memory may know how to do so without walking.
        """
        memory = self.state0(ctrl.shape[:-2], ctrl[..., 0, :], theta, dt)
        if memory is None:
            return self.action(ctrl, theta[..., None, :], None, exogenous, dt)[0]
        out = np.empty(ctrl.shape)
        for t in range(ctrl.shape[-2]):
            signals = {name: values[..., t] for name, values in exogenous.items()}
            out[..., t, :], memory = self.action(ctrl[..., t, :], theta, memory, signals, dt)
        return out

    def friction(self, ctx: Context, theta: Array) -> tuple[Rows, Array]:
        """Dry friction to add: (n dofs, level (..., n) >= 0 in N or N m). MuJoCo's constraint solver applies it."""
        raise NotImplementedError

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:  # noqa: B027 (a hook: does nothing by design)
        """Add generalised forces or body wrenches for the coming step."""

    def rest(self, ctx: Context, theta: Array) -> Any:
        """Hidden state of a joint whose past is unknown, one step before `ctx`."""
        return None

    def follow(self, ctx: Context, theta: Array, memory: Any) -> Any:
        """Hidden state for the step that begins at `ctx`, from that of the step before.

        It reads q, v, ctrl and signals alone: along a measured past there is no simulation to take `data` from.
        """
        raise NotImplementedError

    def modulate(self, ctx: Context, theta: Array, fields: Mapping[str, Array]) -> None:
        """Change the fields of `MODULATES`, (..., *shape), in place for the coming step, from what is there."""
        raise NotImplementedError

    def demand(self, force: Array, theta: Array, ctx: Context) -> Array:
        """Inverse mode: forces (T, nu) that a motion needs of the actuators -> those commanded.

        theta is (k,), and ctx is of (T, ...). What acts on commands is undone first, under the gains that effects on
        these made, and then those gains are.
        """
        return force

    def sense(self, channel: str, values: Array, theta: Array, dt: float) -> Array:
        """True trajectory of a channel (..., time, dim) -> what its sensor reports."""
        return values

    def unsense(self, q: Array, v: Array, theta: Array) -> tuple[Array, Array]:
        """Measured start state -> true start state."""
        return q, v

    # ---- coordinates of a fit -------------------------------------------------------------------------------------

    def chart(self, theta: Array) -> Array:
        """Parameters (..., k) -> coordinates (..., k) in which the motion depends on them nearly linearly.

        Fits walk in these: a lump's mass times its place turns a crooked valley of mass and place into a straight one.
        """
        return theta

    def unchart(self, coordinates: Array) -> Array:
        """The inverse of `chart`."""
        return coordinates

    def starts(self, theta: Array) -> Array:
        """(r, k) other parameters that a fit may start from, along a valley of the chart that holds theta (k,).

        Where psi can take up what one coordinate does, the logs hardly say where along it the truth lies, and a fit
        from one end may never reach the other.
        """
        return np.zeros((0, len(self.params)))

    def outlying(self, theta: Array) -> float:
        """How far from the middle of the part that bears it an effect sits, in sizes of that part; 0 if nowhere.

        One lump may hang on either of two bodies that hardly move against each other: the nearer one carries it.
        """
        return 0.0

    # ---- words ----------------------------------------------------------------------------------------------------

    def say(self, theta: Array, sd: Array | None = None) -> str:
        """One sentence with units."""
        parts = []
        for i, p in enumerate(self.params):
            size = with_spread(theta[i], None if sd is None or p.given else sd[i])
            unit = "" if p.unit == "1" else f" {p.unit}"
            parts.append(f"{p.name.replace('_', ' ')} {size}{unit}")
        return f"{self.summary} at {together(self.where)}: {', '.join(parts)}."


def overrides(effect: Effect, hook: str) -> bool:
    """Whether an effect implements a hook."""
    return getattr(type(effect), hook) is not getattr(Effect, hook)
