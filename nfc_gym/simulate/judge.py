"""What a bank's evidence is worth: log odds of a fault, learned from windows of machines with and without one.

Were the replays' likelihoods exact, the best single evidence would be all there is to know (Neyman and Pearson 1933).
They are not: few replays taken as Gaussian, and blows of contact, give some healthy windows a hundred nats in favour of
a fault, and one limit for each fault, high enough for those, loses many faulty windows. How the evidences lie
*together* tells most of these apart: a fault explains what nothing else explains, a blow nothing explains. The ratio of
densities of all of them is what a classifier between both kinds of windows learns (Sugiyama, Suzuki and Kanamori
2012), here logistic regression on logarithms and their products. A thousand windows of each kind teach it nearly all
that four thousand do (docs/inference.md).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nfc_gym.core.errors import InputError

Array = NDArray[np.float64]
LEAST = 50  # windows of each kind
_UNIT, _MOST = 10.0, 1e6  # nats from which evidence counts by its logarithm, and beyond which it is all the same
_DECAY = 1.0  # of the weights of standardised features, in windows
_ROUNDS, _STILL = 50, 1e-8


@dataclass(frozen=True)
class Judge:
    """Quadratic logistic regression on evidence.

    Attributes:
      mean, scale: (f,) of the features that it was learned from.
      weights: (f,) of the standardised features.
      bias: log odds at their means; kinds of windows count alike, however many there were of each.
    """

    mean: Array
    scale: Array
    weights: Array
    bias: float

    @classmethod
    def learned(cls, healthy: ArrayLike, faulty: ArrayLike) -> "Judge":
        """From evidence of windows.

        Args:
          healthy, faulty: (n, e) and (m, e) nats, see `ReplayBank.evidence`; not those that a threshold is then taken
            from.

        Raises:
          InputError: too few windows, evidence that is not a number, or of different banks.
        """
        kinds = [np.asarray(k, float) for k in (healthy, faulty)]
        for kind, name in zip(kinds, ("healthy", "faulty"), strict=True):
            if kind.ndim != 2 or len(kind) < LEAST or np.isnan(kind).any():
                raise InputError(f"judge: {name} evidence must be {LEAST} windows or more, without NaN; "
                                 f"got shape {kind.shape}")  # fmt: skip
        if kinds[0].shape[1] != kinds[1].shape[1]:
            raise InputError(f"judge: evidence of {kinds[0].shape[1]} and of {kinds[1].shape[1]} columns: other banks")
        raw = np.concatenate([_features(k) for k in kinds])
        mean, scale = raw.mean(0), raw.std(0) + 1e-9
        x = np.c_[np.ones(len(raw)), (raw - mean) / scale]
        y = np.repeat([0.0, 1.0], [len(k) for k in kinds])
        count = np.repeat([len(raw) / (2 * len(k)) for k in kinds], [len(k) for k in kinds])
        found = _regression(x, y, count)
        return cls(mean, scale, found[1:], float(found[0]))

    def odds(self, evidence: ArrayLike) -> Array:
        """(n,) log odds of a fault from evidence (n, e).

        Raises:
          InputError: evidence of another bank.
        """
        features = _features(np.atleast_2d(np.asarray(evidence, float)))
        if features.shape[1] != len(self.mean):
            raise InputError(
                f"judge: evidence has {np.shape(evidence)[-1]} columns, not as many as it was learned from"
            )
        return (features - self.mean) / self.scale @ self.weights + self.bias


def _features(evidence: Array) -> Array:
    """(n, e + e (e + 1) / 2) logarithms, signed and smooth at zero, and their products."""
    logs = np.arcsinh(np.clip(evidence, -_MOST, _MOST) / _UNIT)
    i, j = np.triu_indices(logs.shape[1])
    return np.concatenate([logs, logs[:, i] * logs[:, j]], 1)


def _regression(x: Array, y: Array, count: Array) -> Array:
    """(f,) weights of the penalised logistic likelihood's maximum, by Newton's method with halved steps.

    Args:
      x: (n, f) features, the first of them 1, which is not penalised.
      y: (n,) 0 or 1.
      count: (n,) what each counts.
    """
    decay = np.r_[0.0, np.full(x.shape[1] - 1, _DECAY)]

    def loss(w: Array) -> float:
        z = x @ w
        return float(count @ (np.logaddexp(0, z) - y * z) + decay @ w**2 / 2)

    w = np.zeros(x.shape[1])
    for _ in range(_ROUNDS):
        p = 1 / (1 + np.exp(-np.clip(x @ w, -500, 500)))
        slope = x.T @ (count * (p - y)) + decay * w
        step = np.linalg.solve((x.T * (count * p * (1 - p))) @ x + np.diag(decay + 1e-9), slope)
        before, part = loss(w), 1.0
        while loss(w - part * step) > before and part > 1e-4:
            part /= 2
        w = w - part * step
        if before - loss(w) < _STILL * (1 + before):
            break
    return w
