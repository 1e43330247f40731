"""Returns with intervals, and what one policy has over another on the same episodes."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri, stdtrit

from nfc_gym.adaptation.evaluate import Score

_LEVEL = 0.95


def mean_interval(values: ArrayLike) -> dict[str, float]:
    """Mean of independent values (n,) and its 95 % interval by Student's t; n must be 2 or more."""
    x = np.asarray(values, float)
    half = float(stdtrit(len(x) - 1, (1 + _LEVEL) / 2)) * float(x.std(ddof=1)) / len(x) ** 0.5
    mean = float(x.mean())
    return {"mean": mean, "low": mean - half, "high": mean + half}


def share_interval(flags: ArrayLike) -> dict[str, float]:
    """Share of flags (n,) that are set and its 95 % interval (Wilson, J. Am. Stat. Assoc. 22, 1927)."""
    x = np.asarray(flags, bool)
    n, p, z = len(x), float(np.mean(x)), float(ndtri((1 + _LEVEL) / 2))
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * (p * (1 - p) / n + z**2 / (4 * n**2)) ** 0.5
    return {"mean": p, "low": middle - half, "high": middle + half}


def figure(score: Score) -> dict[str, Any]:
    """A score as reports have it: `return` and, where there is a goal, `success`, each {mean, low, high}."""
    found: dict[str, Any] = {"return": mean_interval(score.returns), "episodes": len(score.returns)}
    found["length"] = float(score.lengths.mean())
    return found if score.reached is None else found | {"success": share_interval(score.reached)}


def gain(after: Score, before: Score) -> dict[str, float]:
    """Mean and interval of the difference in return, after less before, of the same episodes."""
    return mean_interval(after.returns - before.returns)


def to_plain(score: Score) -> dict[str, Any]:
    """A score as JSON can hold it, to the bit."""
    reached = None if score.reached is None else score.reached.tolist()
    return {"returns": score.returns.tolist(), "lengths": score.lengths.tolist(), "reached": reached}


def from_plain(plain: Mapping[str, Any]) -> Score:
    """The inverse of `to_plain`."""
    reached: NDArray[np.bool_] | None = None if plain["reached"] is None else np.array(plain["reached"], bool)
    return Score(np.array(plain["returns"], float), np.array(plain["lengths"], np.intp), reached)
