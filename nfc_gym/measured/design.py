"""Which of two motions tells more: how far apart rival explanations of the logs would come to lie.

Atkinson and Fedorov (1975), Biometrika 62, 57: the best experiment to tell models apart is the one in which the rival,
refitted to it, misses most (T-optimality). Here the rival's parameters and psi are refitted to the present logs and the
new ones together, in the linear approximation around realistic sizes (`fisher`). Where there is no rival the rival is
psi alone, and what is asked is the smallest size that would be found.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cma
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.measured.box import box
from nfc_gym.measured.experiment import Stage
from nfc_gym.measured.fisher import Lens, left_over, realistic, sized, span, without
from nfc_gym.measured.metric import Metric, metric
from nfc_gym.measured.motions import FAMILIES, Family, Series, faded
from nfc_gym.measured.problem import Problem
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
_AMPLITUDES = (1.0, 0.5, 0.2)
_BATCH = 8  # sequences rolled out at once
_STEP = 0.2  # of the optimiser's first draws
_SHRINK = 4  # times smaller that all families are tried again if none stays within bounds


@dataclass(frozen=True)
class Base:
    """A model in which some effect is missing, (plant, x); several questions may share one."""

    plant: Plant
    x: Array


@dataclass(frozen=True)
class Ask:
    """One question: if `effect` at `theta` were at work in the base, would `rival` at `rows` pass for it?

    Attributes:
      theta: (k,) its realistic size.
      rival, rows: the other explanation, (r, k') what it can change; None and nothing asks for psi alone.
      needed: length of column at which the answer is sure, sigma.
    """

    base: Base
    effect: Effect
    theta: Array
    rival: Effect | None
    rows: Array
    needed: float


def mimicking(lens: Lens, column: Array, rival: Effect) -> Array:
    """(r, k) parameter vectors of a rival about the size at which it imitates a column (n,) best."""
    basis = lens.fitted
    target = without(column, basis)
    best, chosen, multiples = -1.0, None, np.zeros(0)
    for whole, rows in realistic(rival):
        thetas = rows if len(rows) else whole
        left = without(lens.columns(rival, thetas).reshape(len(column), -1), basis)
        like = float(np.linalg.norm(span(left).T @ target))
        if like > best:
            best, chosen = like, thetas
            multiples = np.asarray(np.linalg.lstsq(left, target, rcond=1e-6)[0], np.float64)
    assert chosen is not None
    null = sized(rival, chosen[0], 0.0)
    start = rival.chart(null)
    moved = rival.unchart(start + multiples @ (rival.chart(chosen) - start))
    together = np.clip(moved, rival.low, rival.high)[None]
    return together if len(chosen) == 1 else np.concatenate([together, chosen])


class Design:
    """Questions, what the present logs answer, and what a new motion would add.

    Args:
      asks: the questions.
      stage: where sequences are tried.
      present: the logs at hand, and their metric; `repeats` as many of them as are looked at.
    """

    def __init__(self, asks: Sequence[Ask], stage: Stage, present: Problem, under: Metric, repeats: float) -> None:
        self.asks, self.stage = list(asks), stage
        self.root = np.linalg.inv(np.median(np.linalg.inv(under.inverse_root), 0))
        self.bases = list({id(a.base): a.base for a in asks}.values())
        self.models = [(b.plant, b.x) for b in self.bases]
        self.known = [repeats * self._grams(present, under, base, 1)[0] for base in self.bases]
        self.before = self._answers([k[None] for k in self.known])[0]

    def _columns(self, base: Base) -> list[tuple[Effect, Array]]:
        """What is rolled out for a base: each effect once, with every size that a question has of it."""
        out: dict[int, tuple[Effect, list[Array]]] = {}
        for a in self.asks:
            if a.base is base:
                out.setdefault(id(a.effect), (a.effect, []))[1].append(a.theta[None])
                if a.rival is not None:
                    out.setdefault(id(a.rival), (a.rival, []))[1].append(a.rows)
        return [(e, np.unique(np.concatenate(rows), axis=0)) for e, rows in out.values()]

    def _grams(self, problem: Problem, under: Metric, base: Base, parts: int, flat: bool = False) -> Array:
        """(N, c, c) inner products of the tangent and all effects' columns, one a sequence of `parts` logs."""
        weight = np.ones(problem.mask.shape) if flat else None
        lens = Lens(problem, under, base.plant, base.x, weight)
        all_columns = [lens.tangent, *(lens.columns(e, rows) for e, rows in self._columns(base))]
        columns = np.concatenate(all_columns, -1)
        each = np.einsum("smi,smj->sij", columns, columns)
        sequence = problem.log_of // parts if flat else np.zeros(len(problem), np.intp)
        out = np.zeros((int(sequence.max()) + 1, *each.shape[1:]))
        np.add.at(out, sequence, each)
        return out

    def _answers(self, grams: Sequence[Array]) -> Array:
        """(N, asks) distances in sigma, from grams (N, c, c) of each base."""
        out = np.zeros((len(grams[0]), len(self.asks)))
        for base, of in zip(self.bases, grams, strict=True):
            limits = box(base.plant)
            count = len(limits.scale)
            at, where = count, {}
            for effect, rows in self._columns(base):
                where |= {(id(effect), tuple(r)): at + i for i, r in enumerate(rows)}
                at += len(rows)
            for j, a in enumerate(self.asks):
                if a.base is not base:
                    continue
                others = [*range(count), *(where[id(a.rival), tuple(r)] for r in a.rows if a.rival is not None)]
                for i, gram in enumerate(of):
                    gram = gram.copy()
                    gram[range(count), range(count)] += limits.pull**2
                    out[i, j] = np.sqrt(left_over(gram, where[id(a.effect), tuple(a.theta)], others))
        return out

    def answers(self, w: Array) -> tuple[Array, Array]:
        """Distances (N, asks) that present logs and sequences w (N, T, nu) would give, and by how much each oversteps.

        Sequences that leave what was seen have no answer: zeros.
        """
        problem, over = self.stage.trial(w, self.models)
        out = np.zeros((len(w), len(self.asks)))
        if problem is not None:
            root = np.broadcast_to(self.root, (len(problem), *self.root.shape))
            under = Metric(root, problem.mask)
            new = [self._grams(problem, under, base, self.stage.parts, True) for base in self.bases]
            out[over <= 0] = self._answers([k + g for k, g in zip(self.known, new, strict=True)])
        return out, over

    def worth(self, answers: Array, over: Array) -> Array:
        """(N,) what is maximised: the worst question's distance, or without rivals the mean log of what would show."""
        needed = np.array([a.needed for a in self.asks])
        if any(a.rival is not None for a in self.asks):
            value = answers.min(1) + 0.01 * answers.mean(1)
        else:
            value = np.log1p((answers / needed) ** 2).mean(1)
        return np.where(over <= 0, value, -np.minimum(over, 1e3))

    # ---- search -----------------------------------------------------------------------------------------------------

    def families(self, rng: np.random.Generator, amplitudes: Sequence[float] = _AMPLITUDES) -> list["Tried"]:
        """Every family of motion at some amplitudes, best first; those that stay within bounds.

        Raises:
          InputError: none does, however small.
        """
        time_, count = self.stage.time, len(self.stage.room.names)
        for shrink in (1, _SHRINK, _SHRINK**2):
            drawn = [
                (f, a / shrink, faded(np.clip(a / shrink * f.make(rng, time_, count), -1, 1), time_))
                for f in FAMILIES
                for a in amplitudes
            ]
            out: list[Tried] = []
            for i in range(0, len(drawn), _BATCH):
                part = drawn[i : i + _BATCH]
                answers, over = self.answers(np.stack([w for *_, w in part]))
                value = self.worth(answers, over)
                out += [
                    Tried(w, float(v), a, f, s)
                    for (f, s, w), v, a, o in zip(part, value, answers, over, strict=True)
                    if o <= 0
                ]
            if out:
                return sorted(out, key=lambda t: -t.value)
        raise InputError(
            "nothing can be proposed: however small, no motion that was tried stays within the joint ranges and "
            "the motion that the logs show"
        )

    def search(
        self, rng: np.random.Generator, tries: int, budget: float, tick: Callable[[int, float], None]
    ) -> tuple["Tried", int]:
        """The best sequence that was found, and how many were tried.

        Families of motion first; then CMA-ES (Hansen 2001) over a gain and a Fourier series on top of the best.

        Args:
          tries: sequences at most.
          budget: s, after which no new generation begins.
          tick: called with the number tried and the best value so far.
        """
        began = time.monotonic()
        best = self.families(rng)[0]
        done = len(FAMILIES) * len(_AMPLITUDES)
        tick(done, best.value)
        series = Series(best.w, self.stage.time)
        options = {"verbose": -9, "seed": int(rng.integers(1, 2**31)), "popsize": 2 * _BATCH}
        walk = cma.CMAEvolutionStrategy(np.zeros(series.size), _STEP, options)
        while done < tries and time.monotonic() - began < budget and not walk.stop():
            z = walk.ask()
            w = np.stack([series(row) for row in z])
            parts = [self.answers(w[i : i + _BATCH]) for i in range(0, len(w), _BATCH)]
            answers, over = (np.concatenate(p) for p in zip(*parts, strict=True))
            value = self.worth(answers, over)
            walk.tell(z, (-value).tolist())
            done += len(w)
            i = int(value.argmax())
            if value[i] > best.value:
                best = Tried(w[i], float(value[i]), answers[i], best.family, best.amplitude)
            tick(done, best.value)
        return best, done


@dataclass(frozen=True)
class Tried:
    """A sequence (T, nu) in -1..1 that stays within bounds, its value and answers, and the family it comes from."""

    w: Array
    value: float
    answers: Array
    family: Family
    amplitude: float


def present_metric(problem: Problem, plant: Plant, x: Array, extra: Array) -> Metric:
    """Whitening of the logs at hand under the fitted model."""
    return metric(problem, problem.covariance(plant, x), extra)
