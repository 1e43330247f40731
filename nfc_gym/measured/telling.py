"""Lines of progress: how long a run has taken, and what it does now.

They quote names of models and files, in which `:x:` and `[a]` are no emoji and no markup.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Protocol, TypeVar

from rich.console import Console
from rich.text import Text

from nfc_gym.measured.findings import Finding


class Tell(Protocol):
    """Says a line; `lead` comes before it, in bold."""

    def __call__(self, text: str, lead: str = "") -> None:
        """One line."""


_Item = TypeVar("_Item")
_QUIET = 15.0  # s without a word, after which one says how far it is


def paced(say: Callable[[str], object], items: Sequence[_Item]) -> Iterator[_Item]:
    """The items one by one; where they take long, how many are done is said now and then."""
    last = time.monotonic()
    for done, item in enumerate(items):
        if time.monotonic() - last > _QUIET:
            say(f"{done} of {len(items)} so far")
            last = time.monotonic()
        yield item


def warned(console: Console | None, noticed: Iterable[Finding]) -> tuple[Finding, ...]:
    """What `check` warns of, shown as well where there is a console."""
    found = tuple(f for f in noticed if f.severity == "warning")
    if console:
        for warning in found:
            console.print(Text.assemble(("warning", "bold yellow"), f"  {warning}"))
    return found


def teller(console: Console | None, began: float) -> Tell:
    """Lines that begin with the seconds since `began` (of `time.monotonic`); without a console silent."""

    def tell(text: str, lead: str = "") -> None:
        if console:
            seconds = Text(f"{time.monotonic() - began:6.1f} s", "dim")
            console.print(Text.assemble(seconds, "  ", (lead, "bold"), text))

    return tell
