"""Who is told how training goes."""

from typing import Protocol

from rich.console import Console


class Report(Protocol):
    """Hears of epochs and of what is worth a sentence."""

    def epoch(self, done: int, of: int, train: float, held_out: float) -> None:
        """An epoch has ended with these mean losses."""
        ...

    def message(self, text: str) -> None:
        """Something happened that the user should know."""
        ...


class Quiet:
    """Hears and says nothing; warnings are in the outcome."""

    def epoch(self, done: int, of: int, train: float, held_out: float) -> None:
        """Nothing."""

    def message(self, text: str) -> None:
        """Nothing."""


quiet = Quiet()


class Spoken:
    """Prints through rich: a line an epoch that replaces the last one, and every message on a line of its own.

    Args:
      console: default standard error, so that results on standard output stay clean.
    """

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(stderr=True)

    def epoch(self, done: int, of: int, train: float, held_out: float) -> None:
        """One line."""
        end = "\r" if self.console.is_terminal and done < of else "\n"
        self.console.print(
            f"epoch {done:4}/{of}  loss {train:9.4f}  held out {held_out:9.4f}", end=end, highlight=False
        )

    def message(self, text: str) -> None:
        """One line."""
        self.console.print(text, highlight=False, markup=False, emoji=False)
