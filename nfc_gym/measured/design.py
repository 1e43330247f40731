"""Which of many motions tells most: families of them first, then an optimiser on top of the best.

What is maximised is the distance at which rival explanations of the logs would come to lie (`distances`). Where there
is no rival, the rival is psi alone, the truth has an effect at a realistic size, and what counts is how small it could
be to be found.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.measured.distances import Distances
from nfc_gym.measured.envelope import MARGIN
from nfc_gym.measured.experiment import Stage
from nfc_gym.measured.motions import FAMILIES, Family, Series, faded

Array = NDArray[np.float64]
_DRAWS = 3  # of each family
_FIRST = 0.5  # of the time, that families may take
_LARGEST = tuple(0.6**k for k in range(9))  # scales of which a family's draw takes the largest that bounds allow
_REPAIR = (1.0, 0.8, 0.5)  # the same for what the optimiser draws
_BATCH = 8  # sequences rolled out at once
_STEP = 0.05  # of the optimiser's first draws


class Design:
    """Where sequences are tried and judged.

    Args:
      distances: the questions.
      stage: where sequences are tried.
      rivals: whether the questions are about rival explanations, each of which must be answered; else, about what
        would show, on the whole.

    Attributes:
      tried: how many sequences were judged.
    """

    def __init__(self, distances: Distances, stage: Stage, rivals: bool) -> None:
        self.distances, self.stage, self.rivals, self.tried = distances, stage, rivals, 0
        # Where many effects are asked for they are small; rival explanations may move quite differently.
        models = [a.truth for a in distances.asks] if rivals else []
        self.models = [(m.plant, m.x) for m in {id(m): m for m in [*models, *distances.rivals]}.values()]

    def within(self, w: Array, scales: Sequence[float]) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Sequences (N, T, nu), each at the largest of some scales (falling) at which it stays within bounds.

        Returns:
          The scaled sequences, the scales (N,), and which of them do stay within bounds.
        """
        chosen, left = np.full(len(w), scales[-1], np.float64), np.arange(len(w))
        for scale in scales:
            over = self.stage.overstep(np.asarray(scale * w[left], np.float64), self.models)
            chosen[left] = scale
            left = left[over > 0]
            if not len(left):
                break
        return chosen[:, None, None] * w, chosen, ~np.isin(np.arange(len(w)), left)

    def judge(self, w: Array, scales: Sequence[float]) -> tuple[Array, Array, Array, Array]:
        """Sequences (N, T, nu) within bounds, their scales (N,), values (N,), -1 where there are none, and answers."""
        self.tried += len(w)
        w, chosen, fine = self.within(w, scales)
        answers = np.zeros((len(w), len(self.distances.asks)))
        if fine.any():
            problem = self.stage.data(w[fine])
            answers[fine] = self.distances.after(problem, problem.log_of // self.stage.parts)
        needed = np.array([a.needed for a in self.distances.asks])
        # All of the rivals must fall; what would show counts on the whole.
        value = answers.min(1) + 0.01 * answers.mean(1) if self.rivals else np.log1p((answers / needed) ** 2).mean(1)
        return w, chosen, np.where(fine, value, -1.0), answers

    # ---- search -----------------------------------------------------------------------------------------------------

    def families(
        self, rng: np.random.Generator, draws: int = _DRAWS, until: float = np.inf, most: int | None = None
    ) -> list["Tried"]:
        """Every family of motion, drawn so many times, as large as bounds allow; best first.

        Args:
          most: of all of them together, if that is fewer.
          until: `time.monotonic()` from which on what was found is enough.

        Raises:
          InputError: none stays within bounds, however small.
        """
        time_, patterns = self.stage.time, self.stage.patterns
        drawn = [
            (f, pattern, f.make(rng, time_, len(pattern)))
            for f in FAMILIES
            for pattern in (patterns[k % len(patterns)] for k in range(draws))
            if len(pattern) > 1 or not f.takes_turns
        ][:most]
        out: list[Tried] = []
        for i in range(0, len(drawn), _BATCH):
            if out and time.monotonic() > until:
                break
            part = drawn[i : i + _BATCH]
            w = np.stack([faded(np.clip(s @ pattern, -1, 1), time_) for _, pattern, s in part])
            found = self.judge(w, _LARGEST)
            out += [
                Tried(w, v, a, f, c, pattern, c * s)
                for (f, pattern, s), w, c, v, a in zip(part, *found, strict=True)
                if v >= 0
            ]
        if not out:
            raise InputError(
                "nothing can be proposed: however small, no motion that was tried stays within the joint ranges and "
                f"{MARGIN:g} times the motion that the logs show"
            )
        return sorted(out, key=lambda t: -t.value)

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
        best = self.families(rng, until=began + _FIRST * budget, most=tries)[0]
        tick(self.tried, best.value)
        start = best
        series = Series(start.series, start.pattern, self.stage.time)
        options = {"verbose": -9, "seed": int(rng.integers(1, 2**31)), "popsize": 2 * _BATCH}
        import cma  # where it is used: see `fit.polish`

        walk = cma.CMAEvolutionStrategy(np.zeros(series.size), _STEP, options)
        while self.tried < tries and time.monotonic() - began < budget and not walk.stop():
            z = walk.ask()
            w = np.stack([series(row) for row in z[: tries - self.tried]])
            parts = [self.judge(w[i : i + _BATCH], _REPAIR) for i in range(0, len(w), _BATCH)]
            w, _, value, answers = (np.concatenate(p) for p in zip(*parts, strict=True))
            if len(w) == len(z):  # the last ones may be fewer
                walk.tell(z, (-value).tolist())
            i = int(value.argmax())
            if value[i] > best.value:
                best = replace(start, w=w[i], value=float(value[i]), answers=answers[i])
            tick(self.tried, best.value)
        return best, self.tried


@dataclass(frozen=True)
class Tried:
    """A sequence that stays within bounds.

    Attributes:
      w: (T, nu) in -1..1.
      value: what is maximised; answers: (asks,) sigma.
      family, amplitude: of which it was drawn, and how large.
      pattern, series: (m, nu) controls that move together, and (T, m) how much each set of them was to move.
    """

    w: Array
    value: float
    answers: Array
    family: Family
    amplitude: float
    pattern: Array
    series: Array
