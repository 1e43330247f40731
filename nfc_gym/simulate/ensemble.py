"""The ensemble Kalman filter's two formulae, for many windows at once (Evensen 2003, "The ensemble Kalman filter").

M members predict k observations, in units of the sensor noise. Their spread S (M, k), rows divided by sqrt(M - 1),
gives the covariance of the mean error e by

    Sigma = D + (1 - a) S' S,    D = 1 + a diag(S' S):

sensor noise, and what the members disagree about. So few members see few of its directions, so a share a of their
variance counts as independent (a shrinkage). Sums over k are done in the space of the members (Woodbury's identity).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
DIAGONAL = 0.2  # a


class Innovation(NamedTuple):
    """What n windows' observations say against their members.

    Attributes:
      squared: (n,) e' Sigma^-1 e.
      log_det: (n,) log det Sigma.
      gain: (n, M, M) by which members move: row m is the weights, one for each member's deviation, of member m.
    """

    squared: Array
    log_det: Array
    gain: Array


def innovation(errors: Array, eps: Array) -> Innovation:
    """Whitened error of the mean, and the analysis.

    Args:
      errors: (n, M, k) observation less member, in units of the sensor noise.
      eps: (M, k) standard normal: the observation's noise as each member sees it (stochastic analysis).
    """
    m = errors.shape[1]
    mean = errors.mean(1)
    spread = (mean[:, None] - errors) / np.sqrt(m - 1)  # members less their mean
    alone = 1 + DIAGONAL * (spread * spread).sum(1)
    root = 1 / np.sqrt(alone)
    e, s = mean * root, spread * (np.sqrt(1 - DIAGONAL) * root[:, None])
    among = np.eye(m) + s @ s.transpose(0, 2, 1)
    inner, log_det = np.linalg.inv(among), np.log(alone).sum(1) + np.linalg.slogdet(among)[1]
    b = np.einsum("nmk,nk->nm", s, e)
    squared = (e * e).sum(1) - np.einsum("nm,nmj,nj->n", b, inner, b)
    # x_m += X' S Sigma^-1 (e_m + eps_m); S Sigma^-1 = (1 + s s')^-1 s D^-1/2, scaled back by sqrt(1 - a)
    told = (errors + eps) * root[:, None]
    gain = (told @ s.transpose(0, 2, 1)) @ inner.transpose(0, 2, 1) / np.sqrt(1 - DIAGONAL)
    return Innovation(squared, log_det, gain)
