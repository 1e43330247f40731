"""What two descriptions of a run disagree in, for errors that refuse to mix them."""

from collections.abc import Iterator, Mapping
from typing import Any


def differences(kept: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    """In words, for each key of `now` (plain values, as JSON has them) whose value was another; lists are not shown."""
    for key, value in now.items():
        before = kept.get(key)
        if isinstance(value, Mapping) and isinstance(before, Mapping):
            yield from differences(before, value)
        elif before != value:
            shown = not isinstance(value, list | Mapping) and not isinstance(before, list | Mapping)
            yield f"{key} {before!r}, now {value!r}" if shown else f"another {key}"
