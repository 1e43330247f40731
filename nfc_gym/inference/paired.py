"""`close_in`: what one window tells, by simulations of its own commands in pairs that close in on it.

With the commands known, a simulation is e(theta, w): by how much what was observed is off what theta would have done,
in units of the sensors' noise. theta is psi and where the window began, in coordinates in which both are N(0, I)
beforehand; w is what nobody saw, as the noise of motors. Each round simulates pairs at m + L r and m - L r, r of
N(0, I), around what is believed now, N(m, L L'), with the same w in both:

    half their difference is the slope's, D = B r, whatever w was, and what a plane through it leaves, F;
    half their sum is what w makes of it, M, and how far the middle of it is off what was observed, on average.

The sensors' noise, M and F say how much each combination of outputs is worth. W = B' (1 + cov M + cov F)^-1 weighs
them, as the score of a normal likelihood would (Alsing and Wandelt 2018), and leaves of hundreds of outputs as many
numbers as theta has. Of those alone the likelihood is taken (Wood 2010, synthetic likelihood): their slopes, their mean
and their covariance by a round that W does not come from, so that a poor W tells less and never too much. With the
prior they give the next N(m, L L'), around which the next round lies.

No round takes an earlier answer for its prior, and where a round lies does not bias it: a regression on theta has no
such bias. It only says where the robot is taken as linear, and its noise as it is there: noise that grows with a
parameter is not seen as that. What rounds disagree on at the end, beyond what each allows for, is added to the width.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.inference.normal import Normal
from nfc_gym.inference.progress import Report, quiet

Array = NDArray[np.float64]
Errors = Callable[[Array, int], Array]  # (theta (n, p), seed of w) -> (n, K), without the sensors' noise
SIMULATIONS = 10_000
PAIRS = 400  # a round
LAST = 4  # rounds that answer together
_POOLED = 3  # rounds before this one that weights come from too,
_ALIKE = 0.1  # where this one is told so much more than them at most, nats an entry of psi
_FAR = 1.5  # standard deviations, root mean square over theta, that the middle goes in a round
_STILL = 0.03  # nats an entry of psi that `LAST` rounds must have won, or they are the last
_FAIR = 30.0  # standard deviations of the sensors, beyond which what is missed counts by its logarithm


class _Told(NamedTuple):
    """What a round tells of r: information (p, p), and that times where it points, (p,)."""

    information: Array
    towards: Array


class _Round:
    """Pairs around what is believed.

    Args:
      half, middle: (n, K) half the differences and the means of pairs.
      r: (n, p).
      root: (p, p) L.
    """

    def __init__(self, half: Array, middle: Array, r: Array, root: Array) -> None:
        self.half, self.middle, self.r, self.root = half, middle, r, root
        slope = np.linalg.lstsq(r, half, rcond=None)[0]
        left = half - r @ slope
        self.slope = -np.linalg.solve(root.T, slope)  # (p, K) of what is simulated, on theta
        spread = middle - middle.mean(0)
        n, p = r.shape
        # Rows whose squares add up to both covariances.
        self.spread = np.concatenate([left / np.sqrt(n - p), spread / np.sqrt(n - 1)])

    def part(self, rows: slice) -> "_Round":
        """Some of its pairs."""
        return _Round(self.half[rows], self.middle[rows], self.r[rows], self.root)

    def told(self, weights: Array) -> _Told:
        """By statistics `weights` (p, K) of the outputs."""
        half, middle = self.half @ weights.T, self.middle @ weights.T
        n, p = self.r.shape
        slope = np.linalg.lstsq(self.r, half, rcond=None)[0]
        left = half - self.r @ slope
        noise = weights @ weights.T + np.cov(middle.T) * (1 + 1 / n) + left.T @ left / (n - p)
        slope, off = -slope.T, middle.mean(0)
        # What was observed is off by as much as noise and belief say, or more noise is at work than is known of.
        expected = off @ np.linalg.solve(noise + slope @ slope.T, off) / p
        noise *= max(1.0, expected)
        known = np.linalg.solve(noise, np.column_stack([slope, off]))
        return _Told(slope.T @ known[:, :-1], slope.T @ known[:, -1])


def _weights(rounds: list[_Round]) -> Array:
    """(p, K) W of some rounds' slopes and spreads."""
    slope = np.mean([each.slope for each in rounds], 0)
    spread = np.concatenate([each.spread for each in rounds]) / np.sqrt(len(rounds))
    rows, outputs = spread.shape
    if outputs <= rows:
        return np.linalg.solve(np.eye(outputs) + spread.T @ spread, slope.T).T
    # Woodbury: there are fewer rows than outputs.
    return slope - np.linalg.solve(np.eye(rows) + spread @ spread.T, spread @ slope.T).T @ spread


def _told(here: _Round, before: list[_Round]) -> _Told:
    """What a round tells: each half of it by weights that come of the other half, and of rounds before."""
    n = len(here.r)
    one, other = here.part(slice(0, n // 2)), here.part(slice(n // 2, n))
    a, b = one.told(_weights([*before, other])), other.told(_weights([*before, one]))
    return _Told((a.information + b.information) / 2, (a.towards + b.towards) / 2)


def close_in(
    errors: Errors, begin: Normal, size: int, simulations: int = SIMULATIONS, seed: int = 0, report: Report = quiet
) -> Normal:
    """Rounds of pairs around what is believed, until they tell no more or the simulations are used up.

    Args:
      errors: simulates.
      begin: where the first round lies; N(0, I) knows nothing.
      size: entries of theta that are asked for, the first; the others are only to be known as far as that helps.
      simulations: at most.
      seed: of all draws.
      report: is told of the progress.

    Returns:
      What is believed of theta.

    Raises:
      InputError: too few simulations for so many entries, or most of them come apart.
    """
    p = len(begin.mean)
    rounds = max(LAST, simulations // (2 * PAIRS))
    pairs = simulations // (2 * rounds)
    if pairs < 2 * (p + 2):  # half of them are to tell a plane and what it leaves
        raise InputError(
            f"refine: {simulations} simulations are too few for {p} unknowns; want {4 * LAST * (p + 2)} or more"
        )
    believed, done, answers = begin, list[tuple[float, _Round]](), list[Normal]()
    for k in range(rounds):
        rng = np.random.default_rng([seed, k])
        here = _simulated(errors, believed, rng.standard_normal((pairs, p)), int(rng.integers(2**32)))
        now = believed.told(size)
        told = _told(here, [each for then, each in done if now - then < _ALIKE])
        done = [*done, (now, here)][-_POOLED:]
        believed = _next(believed, here.root, told)
        answers.append(believed)
        won = [each.told(size) for each in answers[-LAST - 1 :]]
        report.message(
            f"round {k + 1} of {rounds} at most, {2 * pairs} simulations each: {won[-1]:.2f} nats a parameter"
        )
        if len(won) > LAST and won[-1] - won[0] < _STILL:
            break
    return _together(answers[-LAST:])


def _simulated(errors: Errors, around: Normal, r: Array, seed: int) -> _Round:
    root = np.asarray(np.linalg.cholesky(around.covariance), float)
    away = r @ root.T
    ends = errors(around.mean + away, seed), errors(around.mean - away, seed)
    fine = np.isfinite(ends[0]).all(1) & np.isfinite(ends[1]).all(1)
    if fine.sum() < 2 * (r.shape[1] + 2):
        raise InputError("refine: most simulations come apart: this motion does not fit this robot")
    one, other = (_FAIR * np.arcsinh(end[fine] / _FAIR) for end in ends)
    return _Round((one - other) / 2, (one + other) / 2, r[fine], root)


def _next(believed: Normal, root: Array, told: _Told) -> Normal:
    """The posterior by one round, and no farther from where it was simulated than that says anything."""
    back = np.linalg.inv(root)
    covariance = np.linalg.inv(np.eye(len(root)) + back.T @ told.information @ back)
    covariance = (covariance + covariance.T) / 2
    step = covariance @ (back.T @ told.towards - believed.mean)
    far = float(np.sqrt(np.square(back @ step).mean()))
    share = _FAR / max(far, _FAR)
    missed = (1 - share) * step
    return Normal(believed.mean + share * step, covariance + np.outer(missed, missed) / len(step))


def _together(answers: list[Normal]) -> Normal:
    """One answer of several: their mean, and a width that allows for what they disagree on."""
    mean = np.mean([each.mean for each in answers], 0)
    covariance = np.mean([each.covariance for each in answers], 0)
    apart = np.array([each.mean - mean for each in answers])
    squares = (apart * np.linalg.solve(covariance, apart.T).T).sum() / max(1, len(answers) - 1)
    return Normal(mean, covariance * (1 + squares / len(mean)))
