"""What wrappers ask a simulation to call, for as long as the wrappers live."""

from collections.abc import Callable
from inspect import ismethod
from typing import Any
from weakref import WeakMethod


class Hooks(list[Callable[..., Any]]):
    """Methods to call, in the order in which they were added.

    Only the wrapper holds its method's object: one that was thrown away and replaced by another must not go on acting.
    The list itself is what `refresh` made of it at the beginning of the last episode, for loops that must be fast.
    """

    def __init__(self) -> None:
        super().__init__()
        self._known: list[tuple[int, Callable[[], Callable[..., Any] | None]]] = []

    def add(self, method: Callable[..., Any], rank: int = 0) -> None:
        """A method to call, after all of a lower rank; in the list itself from the next `refresh` on."""
        self._known.append((rank, WeakMethod(method) if ismethod(method) else lambda: method))
        self._known.sort(key=lambda known: known[0])

    def live(self) -> list[Callable[..., Any]]:
        """The methods whose objects still live."""
        self._known = [known for known in self._known if known[1]() is not None]
        return [method for _, known in self._known if (method := known()) is not None]


def refresh(*groups: Hooks) -> None:
    """Drop the methods whose objects are gone: of all groups at once, since what one of them lists lives by that."""
    for hooks in groups:
        hooks.clear()
    for hooks in groups:
        hooks.extend(hooks.live())
