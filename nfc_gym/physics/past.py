"""What was measured before roll-outs start: from it hidden states of effects are made."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.physics.effects.base import Context, Effect

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class Before:
    """The past of n starts; H steps of history end where a start is.

    Attributes:
      qpos, qvel: (n, H + 1, nq), (n, H + 1, nv) measured motion, the start itself last. Only scalar joints are used,
        and in between steps values are interpolated one by one.
      lead: (n, B, nu) commands from where the log begins to where the history does, in coarse steps.
      lead_step: length of such a step, s.
    """

    qpos: Array
    qvel: Array
    lead: Array
    lead_step: float


class _Table:
    """The past of some starts, laid out when it is first asked for."""

    def __init__(self, lay: Callable[[Index], Before], index: Index) -> None:
        self.lay, self.index = lay, index

    @cached_property
    def before(self) -> Before:
        return self.lay(self.index)


class Past:
    """The past of S segments; segments that start at the same place share it.

    Args:
      lay: from indices (n,) of starts to their `Before`. It is called only where an effect has a past to look at.
      index: (S,) the start of each segment.
    """

    def __init__(self, lay: Callable[[Index], Before], index: Index) -> None:
        self._table, self._rows, self._parts = _Table(lay, index), np.arange(len(index)), 1

    @classmethod
    def given(cls, qpos: Array, qvel: Array) -> "Past":
        """Of motion at hand, (S, H + 1, nq), (S, H + 1, nv), with nothing known before it."""
        none = np.zeros((len(qpos), 0, 0))
        return cls(lambda index: Before(qpos[index], qvel[index], none, 0.0), np.arange(len(qpos)))

    def _like(self, table: _Table, rows: Index, parts: int) -> "Past":
        out = object.__new__(Past)
        out._table, out._rows, out._parts = table, rows, parts
        return out

    def pick(self, index: Index) -> "Past":
        """The past of some of the segments."""
        starts = self._table.index[self._rows[index]]
        return self._like(_Table(self._table.lay, starts), np.arange(len(starts)), self._parts)

    def repeat(self, n: int) -> "Past":
        """The past of all segments n times over."""
        return self._like(self._table, np.tile(self._rows, n), self._parts)

    def refine(self) -> "Past":
        """The same past on a grid of half the step."""
        return self._like(self._table, self._rows, 2 * self._parts)

    def motion(self, k: int) -> tuple[Array, Array]:
        """(S, nq), (S, nv) at step k of the history, counted from its beginning."""
        before = self._table.before
        low, part = divmod(k, self._parts)
        share = part / self._parts
        q, v = before.qpos, before.qvel
        if share == 0:
            return q[self._rows, low], v[self._rows, low]
        mix = lambda a: (1 - share) * a[self._rows, low] + share * a[self._rows, low + 1]  # noqa: E731
        return mix(q), mix(v)

    @property
    def lead(self) -> tuple[Array, float]:
        """(S, B, nu) commands before the history, and the length of their steps, s."""
        before = self._table.before
        return before.lead[self._rows], before.lead_step


def trace(effect: Effect, ctx: Context, theta: Array, tracks: Sequence[Index]) -> Any:
    """Hidden states of a force along tracks that are known as a whole.

    Args:
      effect: one with `follow`.
      ctx: N moments, in any order.
      theta: (N, k).
      tracks: for each track, (T, B) the moments in order of time, B of them side by side. All tracks go side by side,
        whatever their lengths: it is the steps in Python that cost.

    Returns:
      the hidden state at every moment, (N, ...) each array of it.
    """
    out: Any = None
    memory: Any = None
    longest_first = sorted(tracks, key=len, reverse=True)
    for k in range(max(map(len, tracks), default=0)):
        rows = np.concatenate([order[k] for order in longest_first if len(order) > k])
        signals = {n: s[rows] for n, s in ctx.exogenous.items()}
        nominal = lambda name, rows=rows: ctx.nominal(name)[rows]  # noqa: E731
        now = Context(ctx.model, ctx.dt, ctx.q[rows], ctx.v[rows], ctx.ctrl[rows], signals, ctx.data, nominal)
        before = effect.rest(now, theta[rows]) if k == 0 else _first(memory, len(rows))
        memory = effect.follow(now, theta[rows], before)
        out = _room(memory, len(theta)) if out is None else out
        _put(out, memory, rows)
    return out


def _first(memory: Any, count: int) -> Any:
    if isinstance(memory, tuple | list):
        return type(memory)(_first(part, count) for part in memory)
    return memory[:count]


def _room(like: Any, count: int) -> Any:
    if isinstance(like, tuple | list):
        return type(like)(_room(part, count) for part in like)
    return np.zeros((count, *np.shape(like)[1:]))


def _put(whole: Any, part: Any, rows: Index) -> None:
    if isinstance(whole, tuple | list):
        for a, b in zip(whole, part, strict=True):
            _put(a, b, rows)
    else:
        whole[rows] = part
