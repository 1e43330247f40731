"""What an effect must bring to be found.

The gain that a candidate brings must exceed the price that the contest charges it, and it must do so in 99.5 % of
repetitions. A gain of expectation g scatters by 2 sqrt(g). Currie (1968), Analytical Chemistry 40, 586, calls this the
detection limit, as against the decision limit that a lucky draw may pass.
"""

from dataclasses import dataclass

import numpy as np

from nfc_gym.measured.contest import price

_SURE = 2.576  # standard deviations: 99.5 %, one-sided


@dataclass(frozen=True)
class Stakes:
    """What the search charges a candidate.

    Attributes:
      count: numbers that it compares, on fit and selection logs.
      dispersion: loss per number of the model to beat.
      worth: share of the whole loss that an effect must explain to be named.
      repeats: how many times the blocks looked at here the search's own blocks are.
    """

    count: int
    dispersion: float
    worth: float
    repeats: float = 1.0

    def needed(self, extra: int) -> float:
        """Length of a column, on the blocks looked at, from which an effect of `extra` parameters is sure to be found.

        The gain's 0.5 % quantile, g - 2 z sqrt(g), must reach the price.
        """
        least = price(self.count, extra, self.dispersion) + self.worth * self.count * self.dispersion
        return float((_SURE + np.sqrt(_SURE**2 + least)) / np.sqrt(self.repeats))
