"""What was asked last, kept for whoever asks it again.

Fits and metrics are refreshed in turns, and each begins where the one before it ended: a tenth of all roll-outs would
be made a second time.
"""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence

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


class Blocks:
    """Answers to the latest questions, block by block: what was asked of some blocks is not worked out again for all.

    Args:
      most: bytes of answers.
      size: blocks that there are.
    """

    def __init__(self, most: int, size: int) -> None:
        self.most, self.size = most, size
        self._answers: OrderedDict[Hashable, tuple[Array, NDArray[np.bool_]]] = OrderedDict()

    def __call__(
        self,
        questions: Sequence[Hashable],
        blocks: NDArray[np.intp],
        answer: Callable[[NDArray[np.intp], NDArray[np.intp]], Array],
    ) -> Array:
        """(P, s, m) answers to P questions about some of the blocks (s,), read-only.

        Args:
          questions: all that each answer depends on besides the block; what they hold lives as long as they are kept.
          blocks: which.
          answer: works out those to some questions, by their places, about some of `blocks`, by theirs: (p, b, m).
        """
        known = [self._answers.get(q) for q in questions]
        missing = np.array([np.ones(len(blocks), bool) if k is None else ~k[1][blocks] for k in known])
        if not missing.size:
            return answer(np.arange(len(known)), np.arange(len(blocks)))
        found: Array | None = None
        for pattern in np.unique(missing, axis=0):
            rows, of = np.flatnonzero((missing == pattern).all(1)), np.flatnonzero(pattern)
            if len(of):
                new = answer(rows, of)
                found = np.empty((len(known), len(blocks), new.shape[-1])) if found is None else found
                found[np.ix_(rows, of)] = new
        for i, kept in enumerate(known):
            if kept is not None:
                found = np.empty((len(known), len(blocks), kept[0].shape[-1])) if found is None else found
                found[i, ~missing[i]] = kept[0][blocks[~missing[i]]]
        assert found is not None  # of one question and one block at least
        for question, row in zip(questions, found, strict=True):
            self._keep(question, blocks, row)
        found.flags.writeable = False
        return found

    def _keep(self, question: Hashable, blocks: NDArray[np.intp], row: Array) -> None:
        kept = self._answers.pop(question, None)
        values, there = (np.empty((self.size, row.shape[-1])), np.zeros(self.size, bool)) if kept is None else kept
        values[blocks], there[blocks] = row, True
        self._answers[question] = values, there
        while self._answers and len(self._answers) * values.nbytes > self.most:
            self._answers.popitem(last=False)
