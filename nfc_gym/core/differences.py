"""What two descriptions of a run disagree in, for errors that refuse to mix them."""

from collections.abc import Iterator, Mapping
from typing import Any


def differences(kept: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    """In words, for each key of either (plain values, as JSON has them) whose value was another; lists are not shown.

    A key that is not there is one whose value is None, or an empty mapping: later code adds such by default.
    """
    for key in [*now, *(k for k in kept if k not in now)]:
        before, value = kept.get(key), now.get(key)
        if all(v is None or isinstance(v, Mapping) for v in (before, value)):
            yield from differences(before or {}, value or {})
        elif before != value:
            shown = not any(isinstance(v, list | Mapping) for v in (before, value))
            yield f"{key} {_said(before)}, now {_said(value)}" if shown else f"another {key}"


def _said(value: Any) -> str:
    return "not given" if value is None else repr(value)
