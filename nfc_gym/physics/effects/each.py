"""An effect with a value of its own at each of several places: several single-place effects that act as one."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.physics.effects.base import Array, Context, Effect, Forces, overrides
from nfc_gym.physics.effects.conditions import Conditioned
from nfc_gym.physics.effects.lookup import Rows
from nfc_gym.physics.fields import ModelFields

if TYPE_CHECKING:
    from nfc_gym.physics.rollout import Plant

_HOOKS = (
    "spec", "model", "action", "rest", "follow", "friction", "modulate", "force", "demand", "sense", "unsense", "chart",
    "unchart",
)  # fmt: skip
_TRAITS = ("family", "summary", "generic", "simpler", "covers", "MODULATES", "driven", "on_drive", "off_before")


class Each(Effect):
    """Members of one family, one a place; parameters are named `<parameter>@<place>`.

    Args:
      members: single-place effects of one family.
    """

    def __init__(self, members: Sequence[Effect]) -> None:
        self.members = tuple(members)
        params = [replace(p, name=f"{p.name}@{m.place}") for m in members for p in m.params]
        super().__init__([w for m in members for w in m.where], params)
        sizes = np.cumsum([0, *(len(m.params) for m in members)])
        self._parts = [slice(a, b) for a, b in pairwise(sizes)]

    @property
    def id(self) -> str:
        """`family:place+place`, as of the tied effect, with a mark that values differ."""
        return f"{self.family}:{self.place}:each"

    @property
    def signals(self) -> tuple[str, ...]:
        """Exogenous signals that any member reads."""
        return tuple(dict.fromkeys(s for m in self.members for s in m.signals))

    @property
    def settings(self) -> dict[str, Any]:
        """Those that the members share."""
        return self.members[0].settings

    @property
    def on_command(self) -> bool:
        """As any member."""
        return self.members[0].on_command

    def bind(self, model: mujoco.MjModel) -> None:
        """Bind every member."""
        self._dofs = np.arange(model.nv)
        for m in self.members:
            m.bind(model)

    def _theta(self, theta: Array) -> list[Array]:
        return [theta[..., p] for p in self._parts]

    def apart(self, theta: Array) -> list[tuple[Effect, Array]]:
        """Each member with its own parameters (..., k), of all of them (..., k')."""
        return list(zip(self.members, self._theta(theta), strict=True))

    def spec(self, spec: mujoco.MjSpec, theta: Array) -> bool:
        """See `Effect`: all members or none, lest one act in the model and beside it as well."""
        parts = list(zip(self.members, self._theta(theta), strict=True))
        tried = spec.copy()
        return all(m.spec(tried, t) for m, t in parts) and all([m.spec(spec, t) for m, t in parts])

    def marks(self, model: mujoco.MjModel) -> dict[str, Array]:
        """See `Effect`."""
        return {name: at for m in self.members for name, at in m.marks(model).items()}

    def model(self, fields: ModelFields, theta: Array) -> None:
        """See `Effect`."""
        for m, t in zip(self.members, self._theta(theta), strict=True):
            m.model(fields, t)

    def state0(self, shape: tuple[int, ...], ctrl: Array, theta: Array, dt: float) -> Any:
        """See `Effect`."""
        return [m.state0(shape, ctrl, t, dt) for m, t in zip(self.members, self._theta(theta), strict=True)]

    def span(self, theta: Array) -> float:
        """See `Effect`."""
        return max(m.span(t) for m, t in self.apart(theta))

    def action(
        self, ctrl: Array, theta: Array, memory: Any, exogenous: Mapping[str, Array], dt: float
    ) -> tuple[Array, Any]:
        """See `Effect`."""
        kept = []
        for m, t, old in zip(self.members, self._theta(theta), memory, strict=True):
            ctrl, new = m.action(ctrl, t, old, exogenous, dt)
            kept.append(new)
        return ctrl, kept

    def course(self, ctrl: Array, theta: Array, exogenous: Mapping[str, Array], dt: float) -> Array:
        """See `Effect`."""
        for m, t in self.apart(theta):
            ctrl = m.course(ctrl, t, exogenous, dt)
        return ctrl

    def friction(self, ctx: Context, theta: Array) -> tuple[Rows, Array]:
        """See `Effect`."""
        both = [m.friction(ctx, t) for m, t in zip(self.members, self._theta(theta), strict=True)]
        return np.concatenate([self._dofs[d] for d, _ in both]), np.concatenate([level for _, level in both], -1)

    def rest(self, ctx: Context, theta: Array) -> Any:
        """See `Effect`."""
        return [m.rest(ctx, t) for m, t in zip(self.members, self._theta(theta), strict=True)]

    def follow(self, ctx: Context, theta: Array, memory: Any) -> Any:
        """See `Effect`."""
        return [m.follow(ctx, t, o) for m, t, o in zip(self.members, self._theta(theta), memory, strict=True)]

    def modulate(self, ctx: Context, theta: Array, fields: Mapping[str, Array]) -> None:
        """See `Effect`."""
        for m, t in self._recalling(ctx, theta):
            m.modulate(ctx, t, fields)

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        """See `Effect`."""
        for m, t in self._recalling(ctx, theta):
            m.force(ctx, t, out)

    def _recalling(self, ctx: Context, theta: Array) -> Iterator[tuple[Effect, Array]]:
        """Each member and its values, with its own hidden state in `ctx`."""
        memories = ctx.memory if ctx.memory is not None else [None] * len(self.members)
        for m, t, memory in zip(self.members, self._theta(theta), memories, strict=True):
            ctx.memory = memory
            yield m, t

    def demand(self, force: Array, theta: Array, ctx: Context) -> Array:
        """See `Effect`."""
        for m, t in zip(self.members, self._theta(theta), strict=True):
            force = m.demand(force, t, ctx)
        return force

    def sense(self, channel: str, values: Array, theta: Array, dt: float) -> Array:
        """See `Effect`."""
        for m, t in self.apart(theta):
            values = m.sense(channel, values, t, dt)
        return values

    def chart(self, theta: Array) -> Array:
        """See `Effect`."""
        return np.concatenate([m.chart(t) for m, t in zip(self.members, self._theta(theta), strict=True)], -1)

    def unchart(self, coordinates: Array) -> Array:
        """See `Effect`."""
        return np.concatenate([m.unchart(t) for m, t in zip(self.members, self._theta(coordinates), strict=True)], -1)


def each(members: Sequence[Effect]) -> Each:
    """An `Each` that implements just the hooks its members' family implements."""
    first = members[0]
    name = f"Each{type(first).__name__}"
    body: dict[str, Any] = {k: getattr(first, k) for k in _TRAITS}
    body |= {hook: getattr(Effect, hook) for hook in _HOOKS if not overrides(first, hook)}
    return type(name, (Each,), body)(members)


def split(effect: Effect, plant: "Plant") -> tuple[Effect, NDArray[np.intp]] | None:
    """A tied effect of several places as `Each`, and the old parameter each new one starts from; None if it cannot."""
    if isinstance(effect, Each | Conditioned) or len(effect.where) < 2 or effect.generic or not effect.divisible:
        return None
    # What bounds all joints alike is no bound of one: a knee carries more than the typical joint of a leg.
    own = [e.params for e in effect.singles] or [effect.params] * len(effect.where)
    members = [type(effect)((name,), params) for name, params in zip(effect.where, own, strict=True)]
    for member in members:
        vars(member).update(effect.settings)
    together = each(members)
    together.bind(plant.model)
    return together, np.tile(np.arange(len(effect.params)), len(members))
