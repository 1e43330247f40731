"""What was asked last, kept for whoever asks it again.

Fits and metrics are refreshed in turns, and each begins where the one before it ended: a tenth of all roll-outs would
be made a second time.
"""

from collections import OrderedDict
from collections.abc import Callable, Hashable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Recent:
    """Answers to the latest questions; those that were not asked for longest make room.

    Args:
      most: bytes of answers.
    """

    def __init__(self, most: int) -> None:
        self.most, self.size = most, 0
        self._answers: OrderedDict[Hashable, Array] = OrderedDict()

    def __call__(self, question: Hashable, answer: Callable[[], Array]) -> Array:
        """The answer, read-only.

        Args:
          question: all that the answer depends on; what it holds lives as long as the answer is kept.
          answer: works it out.
        """
        if question in self._answers:
            self._answers.move_to_end(question)
            return self._answers[question]
        found = answer()
        found.flags.writeable = False
        self._answers[question] = found
        self.size += found.nbytes
        while self.size > self.most:
            self.size -= self._answers.popitem(last=False)[1].nbytes
        return found
