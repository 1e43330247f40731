"""Lines of progress: how long a run has taken, and what it does now.

They quote names of models and files, in which `:x:` and `[a]` are no emoji and no markup.
"""

import time
from typing import Protocol

from rich.console import Console
from rich.text import Text


class Tell(Protocol):
    """Says a line; `lead` comes before it, in bold."""

    def __call__(self, text: str, lead: str = "") -> None:
        """One line."""


def teller(console: Console | None, began: float) -> Tell:
    """Lines that begin with the seconds since `began` (of `time.monotonic`); without a console silent."""

    def tell(text: str, lead: str = "") -> None:
        if console:
            seconds = Text(f"{time.monotonic() - began:6.1f} s", "dim")
            console.print(Text.assemble(seconds, "  ", (lead, "bold"), text))

    return tell
