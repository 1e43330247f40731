"""The impulse tensor: how every compared number answers a unit force on each degree of freedom at each time.

For small forces the residual changes by the sum over time of force times answer. One pass of roll-outs therefore
serves any law f(q), f(v), f(t), f(command), f(place) on any degree of freedom: its column is a product of matrices.
Roll-outs are pushed in blocks of time; what is compared sample by sample (inverse, forward) answers at the sample.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.fit import Fit
from nfc_gym.measured.instant import InstantProblem, still
from nfc_gym.measured.metric import Metric
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.physics.effects.base import Array, Context, Effect, Forces
from nfc_gym.physics.effects.law import Law
from nfc_gym.physics.effects.param import Param
from nfc_gym.physics.rollout import Plant

CLOCK = "impulse:clock"  # physics steps since the segment began
_BLOCKS = 8  # of time in a segment
_WORK = 250_000  # physics steps of all roll-outs of one tensor; more segments than that allows are thinned evenly
_LEAST = 24  # segments that such a thinning leaves


class _Push(Effect):
    """A constant force on each of some degrees of freedom, from one step of the segment to another."""

    family = "impulse"
    summary = "A unit force"

    def __init__(self, dofs: Sequence[int], timed: bool) -> None:
        names = [f"f{d}" for d in dofs] + (["start", "end"] if timed else [])
        super().__init__(("all",), [Param(n, "N", -np.inf, np.inf) for n in names])
        self.dofs, self.timed = list(dofs), timed

    @property
    def signals(self) -> tuple[str, ...]:
        """The clock, where the push begins and ends."""
        return (CLOCK,) if self.timed else ()

    def force(self, ctx: Context, theta: Array, out: Forces) -> None:
        """See `Effect`."""
        size = theta[..., : len(self.dofs)]
        if self.timed:
            now = ctx.exogenous[CLOCK]
            size = size * ((now >= theta[..., -2]) & (now < theta[..., -1]))[..., None]
        out.qfrc[..., self.dofs] += size


@dataclass(frozen=True)
class Tensor:
    """Answers of S blocks with m numbers each, and the motion at which laws are evaluated.

    Attributes:
      context: arrays (S, T, ...): the motion, as measured where it was and as the model rolls out between.
      index: (S,) of the problem's blocks.
      dofs: degrees of freedom that were pushed.
      answer: (S, D, B, m) whitened change for a unit force in one of B blocks of the T steps.
      pointwise: with B = 1, whether each of the T samples answers by itself alone, with m / T numbers.
    """

    context: Context
    index: NDArray[np.intp]
    dofs: tuple[int, ...]
    answer: Array
    pointwise: bool = False

    def weighted(self, weight: Array) -> "Tensor":
        """The tensor with each number times a weight (S, m)."""
        return replace(self, answer=self.answer * weight[:, None, None, :])

    def columns(self, law: Law, shapes: Array) -> Array:
        """(G, terms, S, m) change of the residual for each of a law's terms at unit size, at shapes (G, s)."""
        basis = law.basis(self.context, shapes[:, None, None, :])
        if law.in_body:
            along = law.direction(self.context)
            pairs = [(law.first + i, basis * along[..., i : i + 1]) for i in range(3)]
        else:
            pairs = [(law.dof, basis)]
        size, count, (groups, *_, terms) = len(self.index), self.answer.shape[-1], basis.shape
        out = np.zeros((size, groups * terms, count))
        for dof, force in pairs:
            answer = self.answer[:, self.dofs.index(dof)]
            if self.pointwise:
                out += np.repeat(_flat(force), count // force.shape[2], axis=-1) * answer
            else:
                out += _flat(_in_blocks(force, answer.shape[1])) @ answer
        return out.reshape(size, groups, terms, count).transpose(1, 2, 0, 3)


def _flat(force: Array) -> Array:
    """(S, G k, B) of (G, S, B, k)."""
    groups, size, blocks, terms = force.shape
    return np.ascontiguousarray(force.transpose(1, 0, 3, 2)).reshape(size, groups * terms, blocks)


def _in_blocks(values: Array, blocks: int) -> Array:
    """Means (G, S, B, k) of (G, S, T, k) over T cut into B stretches."""
    if values.shape[2] == blocks:
        return values
    edges = _edges(values.shape[2], blocks)
    return np.add.reduceat(values, edges[:-1], axis=2) / np.diff(edges)[:, None]


def _edges(steps: int, blocks: int) -> NDArray[np.intp]:
    return np.linspace(0, steps, blocks + 1).round().astype(np.intp)


def impulse(problem: Problem, metric: Metric, current: Fit, sizes: dict[int, float]) -> Tensor | None:
    """The tensor of a fitted model; None for a kind of problem that has none.

    Args:
      sizes: dof -> a realistic force there, at which the answer is taken (where bodies touch it is no derivative).
    """
    if isinstance(problem, RolloutProblem):
        return _rolled(problem, metric, current, sizes)
    if isinstance(problem, InstantProblem):
        return _instant(problem, metric, current, sizes)
    return None


def _rolled(problem: RolloutProblem, metric: Metric, current: Fit, sizes: dict[int, float]) -> Tensor:
    steps = problem.segments.steps
    blocks = min(_BLOCKS, steps)
    most = max(_LEAST, int(_WORK / (steps * blocks * max(len(sizes), 1))))
    index = np.unique(np.linspace(0, len(problem) - 1, min(len(problem), most)).round().astype(np.intp))
    part, under = problem.take(index), metric.take(index)
    seg = part.segments
    clock = np.broadcast_to(np.arange(-seg.history, steps, dtype=float), seg.ctrl.shape[:2])
    part = part.beginning(replace(seg, exogenous={**seg.exogenous, CLOCK: clock}))
    push = _Push(list(sizes), timed=True)
    plant = current.plant.with_effects([*current.plant.effects, push])
    edges = _edges(steps, blocks).astype(float)
    edges[0] = 0.5 if seg.settle else 0.0  # while a segment settles its clock stands at 0
    answer = np.zeros((len(index), len(sizes), blocks, len(part.columns)))
    base = part.residual(current.plant, current.x[None])
    for d, size in enumerate(sizes.values()):  # a degree of freedom at a time bounds the batch
        rows = np.zeros((blocks, len(push.params)))
        rows[:, d], rows[:, -2], rows[:, -1] = size, edges[:-1], edges[1:]
        x = np.concatenate([np.repeat(current.x[None], blocks, 0), rows], 1)
        answer[:, d] = _change(part, under, plant, x, base).transpose(1, 0, 2) / size
    return Tensor(_motion(part, current), index, tuple(sizes), answer)


def _change(problem: Problem, metric: Metric, plant: Plant, x: Array, base: Array) -> Array:
    """(P, S, m) whitened change from a residual (1, S, m); blocks that are unstable with or without answer nothing."""
    residual = problem.residual(plant, x)
    stable = np.isfinite(residual).all(-1, keepdims=True) & np.isfinite(base).all(-1, keepdims=True)
    return np.where(stable, metric.whiten(residual) - metric.whiten(base), 0.0)


def _motion(problem: RolloutProblem, current: Fit) -> Context:
    """The roll-outs of a model, drawn to the measured states where these exist."""
    seg, model = problem.segments, current.plant.model
    traj = current.plant.shoot(current.x[None], seg)
    q, v = np.nan_to_num(traj.qpos[0, :, :-1]), np.nan_to_num(traj.qvel[0, :, :-1])
    for s, row in enumerate(problem.stretches()):
        for mine, theirs, which in ((q, row.qpos, row.straight), (v, row.qvel, row.observed)):
            for i in np.flatnonzero(which):
                error = theirs[:, i] - np.interp(row.steps, np.arange(seg.steps), mine[s, :, i])
                mine[s, :, i] += np.interp(np.arange(seg.steps), row.steps, error)
    late = slice(seg.history, None)
    return still(model, seg.dt, q, v, seg.ctrl[:, late], {k: s[:, late] for k, s in seg.exogenous.items()})


def _instant(problem: InstantProblem, metric: Metric, current: Fit, sizes: dict[int, float]) -> Tensor:
    """The force acts at all samples at once, and what is compared answers where it is compared."""
    push, force = _Push(list(sizes), timed=False), np.array(list(sizes.values()))
    plant = current.plant.with_effects([*current.plant.effects, push])
    x = np.concatenate([np.repeat(current.x[None], len(sizes), 0), np.diag(force)], 1)
    change = _change(problem, metric, plant, x, problem.residual(current.plant, current.x[None]))
    answer = (change / force[:, None, None]).transpose(1, 0, 2)[:, :, None, :]
    return Tensor(problem.motion(plant.model), np.arange(len(problem)), tuple(sizes), answer, pointwise=True)
