"""How wide a posterior is to be, told by windows that are simulated at its own draws.

What truncated rounds learn is too sure of itself. Nearly all of a region's volume lies near its edge, which cuts the
posteriors of most windows, and a network of few windows gives all the same spread. To a regression a ball of radius R
in d dimensions is a prior of variance R^2 / (d + 2), 1.5 to 1.9 times a posterior's spread where its draws end, so that
0.84 to 0.88 of that spread comes out. Windows that were held out lie where the others do and do not show it; nor do
errors of the network at fresh windows near the observed one, whose estimates shrink towards the region's middle.

A regression of what the network says on psi has no such flaw: which psi were drawn does not bias it. With t = B z + e
of what it says of fresh windows, e of covariance R, the posterior given t has the precision I + B^T R^-1 B in probit
coordinates, whatever the shrinking: exactly so where all is linear and normal (Fearnhead and Prangle 2012 of summaries
by regression; Price et al., Bayesian synthetic likelihood, 2018, of a normal through them).
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LEAST = 4  # windows to a parameter, and some, or a covariance tells nothing


def log_volume(z: Array, t: Array) -> float:
    """Half the log determinant of the covariance of z given t, under the prior N(0, I), both normal and linear.

    Args:
      z: (n, d) what windows were simulated with, however it was drawn.
      t: (n, d) a statistic of each.
    """
    n, d = z.shape
    z, t = z - z.mean(0), t - t.mean(0)
    inverse = np.linalg.inv(z.T @ z)
    slope = (inverse @ z.T @ t).T
    left = t - z @ slope.T
    precision = np.linalg.inv(left.T @ left) * (n - 2 * d - 2)  # unbiased: the residuals are Wishart of n - d - 1
    told = slope.T @ precision @ slope - d * inverse  # less what a slope that is off by chance tells
    return -0.5 * float(np.log1p(np.maximum(np.linalg.eigvalsh(told), 0)).sum())


def factor(z: Array, t: Array, own: Array) -> float:
    """By which a posterior is to be widened, 1 or more, in every one of d dimensions.

    Args:
      z: (n, d) draws of it, in probit coordinates.
      t: (n, d) what the network says of windows simulated with them.
      own: (m, d) draws of the posterior.
    """
    d = z.shape[1]
    half = 0.5 * float(np.linalg.slogdet(np.atleast_2d(np.cov(own.T)))[1])
    return max(1.0, float(np.exp((log_volume(z, t) - half) / d)))
