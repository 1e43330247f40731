"""Classifier two-sample test: how well a network tells two sets of samples apart (Lopez-Paz and Oquab 2017)."""

import warnings

import numpy as np
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.model_selection import KFold, cross_val_score
from sklearn.neural_network import MLPClassifier

Array = NDArray[np.float64]


def c2st(a: Array, b: Array, seed: int = 0) -> float:
    """Mean accuracy over five folds: 0.5 where the sets cannot be told apart, 1 where they have nothing in common.

    The classifier is scikit-learn's, with the layers of the simulation-based inference benchmark (two of 10 d rectified
    units, Adam, inputs standardised by the first set), stopped early on a tenth of its training data: without that it
    overfits, takes ten times as long and is the weaker test.
    """
    middle, spread = a.mean(0), a.std(0)
    x = np.concatenate([(s - middle) / spread for s in (a, b)])
    y = np.repeat([0, 1], [len(a), len(b)])
    width = 10 * a.shape[1]
    judge = MLPClassifier((width, width), batch_size=500, early_stopping=True, max_iter=200, random_state=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        warnings.filterwarnings("ignore", "Got `batch_size`", UserWarning)  # few draws are one batch
        return float(cross_val_score(judge, x, y, cv=KFold(5, shuffle=True, random_state=seed)).mean())
