"""Rivals that the search left standing, asked once more on every segment of the logs.

The search looks at no more than so many segments, however much was recorded: of a recording that was made to tell two
explanations apart, and lies among many that do not, few are among them.
"""

from collections.abc import Callable, Sequence

import numpy as np

from nfc_gym.measured.contest import bootstrap, clusters, dispersion, losses, price
from nfc_gym.measured.distances import Ask
from nfc_gym.measured.fit import fit
from nfc_gym.measured.metric import metric
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.settle import slack

LEVEL = 0.025  # as in the contest
_ROUNDS = 12  # iterations of each fit


def excluded(whole: Problem, asks: Sequence[Ask], say: Callable[[str], None], seed: int) -> list[bool]:
    """Whether each rival, refitted to all segments, explains them worse than what it is a rival of.

    Args:
      whole: the segments.
      asks: questions of one truth.

    Returns:
      One bool each, at the contest's level. False where bodies touch: there slopes alone do not lead to the best fit.
    """
    if whole.rough or not asks:
        return [False] * len(asks)
    plant, x = asks[0].truth.plant, asks[0].truth.x
    sigma = whole.covariance(plant, x)
    under = metric(whole, sigma, slack(whole, sigma, plant, x))
    best = fit(whole, under, plant, x, _ROUNDS)
    own, found, groups = losses(whole, under, best), [], clusters(whole)
    for ask in asks:
        say(f"asking {', '.join(e.id for e in ask.rival.plant.effects)} on all {len(whole)} segments")
        apart = losses(whole, under, fit(whole, under, ask.rival.plant, ask.rival.x, _ROUNDS)) - own
        more = max(len(x) - len(ask.rival.x), 0)  # parameters, which gain something wherever they are fitted
        cost = price(int(whole.mask.sum()), more, dispersion(best))
        draws = bootstrap(apart, groups, np.random.default_rng(seed)) - cost
        found.append(bool(np.quantile(draws, LEVEL) > 0))
    return found
