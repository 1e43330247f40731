"""The baseline: is a window unlike the nominal ones, whatever was commanded?"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Unconditional:
    """Mahalanobis distance of a window's means and deviations from those of training windows."""

    def __init__(self, windows: dict[str, NDArray]) -> None:
        x = self.summaries(windows)
        self.mean = x.mean(0)
        scale = x.std(0) + 1e-9
        covariance = np.cov((x / scale).T) + 0.05 * np.eye(x.shape[1])  # a ridge, few windows having many summaries
        self.root = np.linalg.inv(np.linalg.cholesky(covariance)) / scale

    @staticmethod
    def summaries(windows: dict[str, NDArray]) -> Array:
        """(n, 4 s)."""
        s = windows["states"]
        d = np.diff(s, axis=1)
        return np.concatenate([s.mean(1), s.std(1), d.mean(1), d.std(1)], 1)

    def score(self, windows: dict[str, NDArray]) -> Array:
        """(n,)."""
        return (((self.summaries(windows) - self.mean) @ self.root.T) ** 2).sum(1)
