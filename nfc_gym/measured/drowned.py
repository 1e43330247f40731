"""Whether what a calibrated model misses is no more than the noise of its own starts makes.

The metric takes what start states are off by to act on the motion along straight lines. Where it does not (a hull in
water, whose quadratic forces magnify what speeds are off by), a perfect model shows many times the misfit of the
sensors' noise, and any law that calms the motion seems to mend it. Twins of the logs tell: the model's own motion, with
fresh noise, through the same pipeline. A model that misses no more than its twins do has nothing to explain.
"""

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.metric import Metric
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.verdict import mean_square, twin
from nfc_gym.physics.rollout import Plant

MAGNIFIED = 1.15  # mean square of a twin's whitened numbers from which on noise is magnified; 1 on straight lines
_TWINS = 3
REASON = "no candidate was tried: the noise of the start states, which this motion magnifies, makes as large a misfit"
ADVICE = (
    "Small errors of the start states grow so fast in this motion that they alone would make the misfit: nothing that "
    "may be missing can be told from them, and what is calibrated is less sure than its interval says. Measure speeds, "
    "sample faster, or say a shorter segments.length"
)


def drowned(problem: Problem, under: Metric, plant: Plant, x: NDArray[np.float64], seed: int) -> bool:
    """Whether noise alone makes as much of a misfit as there is.

    Args:
      problem: what a model was calibrated on; one where bodies touch has drawn starts in its metric, and is not asked.
      under: its metric at the model.
      plant, x: the model, calibrated.
      seed: of the twins' noise.
    """
    if problem.rough:
        return False
    # A covariance is most of what a twin costs, and by the one at hand a magnified noise shows as well.
    shown: list[float] | None = []
    for shared in (True, False):
        shown = _magnified(problem, under, plant, x, np.random.default_rng(seed), shared)
        if shown is None:
            return False
    own = mean_square(problem, under.whiten(problem.residual(plant, x[None]))[0])
    # The middle one: a single segment that comes apart in one of them is no measure of the others.
    return own <= float(np.median(shown))


def _magnified(
    problem: Problem, under: Metric, plant: Plant, x: NDArray[np.float64], rng: np.random.Generator, shared: bool
) -> list[float] | None:
    """What twins show, by the metric at hand if `shared`; None where most of them show noise as it is declared."""
    shown = list[float]()
    while len(shown) < _TWINS:
        made = twin(problem, under, plant, x, rng, shared)
        if made is None:
            return None
        shown.append(mean_square(*made))
        if sum(s < MAGNIFIED for s in shown) > _TWINS / 2:
            return None
    return shown
