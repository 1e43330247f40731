"""What a robot earns as a sign that something is wrong: on ground whose bumps hide a fault, its work does not.

A detector compares motion with motion at home, and where every map shakes the robot in a way of its own, what a fault
adds is lost in that. A robot that earns less than it did at home is not as it was, whatever shakes it.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtrc

from nfc_gym.core.errors import InputError

LAST = 5  # trajectories that are looked at together: one that went badly may be bad luck
RATE = 0.025  # of trajectories at home that may count as too poor, at most
_FEWEST = 40  # returns at home: one in 1 / RATE of them must be there to be seen


def require_home(returns: Sequence[float]) -> np.ndarray:
    """(n,) returns at home; raises `InputError` where they cannot say what is usual."""
    home = np.asarray(returns, float)
    if home.ndim != 1 or len(home) < _FEWEST or not np.isfinite(home).all():
        raise InputError(
            f"adapt: home holds {home.size} returns ({int(np.isfinite(home).sum())} finite); want {_FEWEST} or more "
            "episodes of the policy in the nominal world"
        )
    return home


def chance(home: np.ndarray, returns: Sequence[float]) -> float:
    """How likely the last few returns, or poorer ones, would be at home (Fisher's combined test, 1925).

    Args:
      home: (n,) returns of episodes there.
      returns: in the world, in their order; the last `LAST` count.
    """
    last = np.asarray(returns, float)[-LAST:]
    poorer = (1 + (home[None] <= last[:, None]).sum(1)) / (1 + len(home))
    return float(chdtrc(2 * len(last), -2 * np.log(poorer).sum()))
