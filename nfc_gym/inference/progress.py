"""Who is told how training goes."""

from datetime import timedelta
from time import monotonic
from typing import Protocol

from rich.console import Console

_WIDTH = 60  # characters
_AFRESH, _LINES = 0.5, 60.0  # seconds between words within an epoch: on a terminal, and where lines stay


class Report(Protocol):
    """Hears of steps, of epochs and of what is worth a sentence."""

    def step(self, done: int, of: int, seconds: float) -> None:
        """So many steps of at most so many are done, in so many seconds."""
        ...

    def epoch(self, done: int, of: int, train: float, held_out: float) -> None:
        """An epoch has ended with these mean losses."""
        ...

    def message(self, text: str) -> None:
        """Something happened that the user should know."""
        ...


class Quiet:
    """Hears and says nothing; warnings are in the outcome."""

    def step(self, done: int, of: int, seconds: float) -> None:
        """Nothing."""

    def epoch(self, done: int, of: int, train: float, held_out: float) -> None:
        """Nothing."""

    def message(self, text: str) -> None:
        """Nothing."""


quiet = Quiet()


class Spoken:
    """Prints through rich: a line an epoch that replaces the last one, and every message on a line of its own.

    Within an epoch it says how far training is and how long it takes at most; where lines cannot be replaced, once a
    minute.

    Args:
      console: default standard error, so that results on standard output stay clean.
    """

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(stderr=True)
        self._said = monotonic()

    def step(self, done: int, of: int, seconds: float) -> None:
        """One line, now and then; training may end sooner, when held-out windows no longer gain."""
        if monotonic() - self._said < (_AFRESH if self.console.is_terminal else _LINES):
            return
        left = timedelta(seconds=round(seconds / done * (of - done)))
        self._line(f"step {done}/{of}  at most {left} left", stays=False)

    def epoch(self, done: int, of: int, train: float, held_out: float) -> None:
        """One line."""
        self._line(f"epoch {done:4}/{of}  loss {train:9.4f}  held out {held_out:9.4f}", stays=done == of)

    def message(self, text: str) -> None:
        """One line."""
        self._line(text, stays=True)

    def _line(self, text: str, stays: bool) -> None:
        """A line, over the last one where that was not to stay and can be replaced."""
        on = self.console.is_terminal
        end = "\n" if stays or not on else "\r"
        # Filled up to the width of the longest that is replaced, so that nothing of it remains.
        self.console.print(text.ljust(_WIDTH) if on else text, end=end, highlight=False, markup=False, emoji=False)
        self._said = monotonic()
