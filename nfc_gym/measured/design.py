"""Which of many motions tells most: families of them first, then an optimiser on top of the best.

What is maximised is the distance at which rival explanations of the logs would come to lie (`distances`). Where there
is no rival, the rival is psi alone, the truth has an effect at a realistic size, and what counts is how small it could
be to be found.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cma
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.measured.distances import Distances
from nfc_gym.measured.experiment import Stage
from nfc_gym.measured.motions import FAMILIES, Family, Series, faded

Array = NDArray[np.float64]
_AMPLITUDES = (1.0, 0.5, 0.2)
_BATCH = 8  # sequences rolled out at once
_STEP = 0.05  # of the optimiser's first draws
_SHRINK = 4  # times smaller that all families are tried again if none stays within bounds


class Design:
    """Where sequences are tried and judged.

    Args:
      distances: the questions.
      stage: where sequences are tried.
      rivals: whether the questions are about rival explanations, each of which must be answered; else, about what
        would show, on the whole.
    """

    def __init__(self, distances: Distances, stage: Stage, rivals: bool) -> None:
        self.distances, self.stage, self.rivals = distances, stage, rivals
        # Where many effects are asked for they are small; rival explanations may move quite differently.
        models = [a.truth for a in distances.asks] if rivals else []
        self.models = [(m.plant, m.x) for m in {id(m): m for m in [*models, *distances.rivals]}.values()]

    def answers(self, w: Array) -> tuple[Array, Array]:
        """Distances (N, asks) that present logs and sequences w (N, T, nu) would give, and by how much each oversteps.

        Sequences that leave what was seen have no answer: zeros.
        """
        problem, over = self.stage.trial(w, self.models)
        out = np.zeros((len(w), len(self.distances.asks)))
        if problem is not None:
            out[over <= 0] = self.distances.after(problem, problem.log_of // self.stage.parts)
        return out, over

    def worth(self, answers: Array, over: Array) -> Array:
        """(N,) what is maximised: the worst question's distance, or without rivals the mean log of what would show."""
        needed = np.array([a.needed for a in self.distances.asks])
        value = answers.min(1) + 0.01 * answers.mean(1) if self.rivals else np.log1p((answers / needed) ** 2).mean(1)
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
