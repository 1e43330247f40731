"""Columns out of decoded ROS messages: numbers by field, arrays by entry or by the names that a message gives them."""

from collections.abc import Iterable, Iterator
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

LONGEST_ARRAY = 64  # the 6 x 6 covariances of nav_msgs fit
_NAMES = ("name", "names", "joint_names")
_TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
Columns = dict[str, NDArray[Any]]


class Types:
    """The fields of message types, and which of them are numbers, times, arrays."""

    def __init__(self, store: Any) -> None:
        self._store = store
        self._known: dict[str, list[tuple[str, str, Any]]] = {}

    def fields(self, msgtype: str) -> list[tuple[str, str, Any]]:
        """(name, kind, detail): kind is number, time, numbers, text, texts, message, messages."""
        if msgtype not in self._known:
            self._known[msgtype] = [self._field(*f) for f in self._store.get_msgdef(msgtype).fields]
        return self._known[msgtype]

    @staticmethod
    def _field(name: str, desc: tuple[Any, Any]) -> tuple[str, str, Any]:
        node, detail = desc
        many = node.name in ("ARRAY", "SEQUENCE")
        if many:
            node, detail = detail[0]
        if node.name == "BASE":
            kind = "text" if detail[0] in ("string", "wstring") else "number"
            return name, kind + "s" * many, None
        if detail in _TIMES:
            return name, "times" if many else "time", None
        return name, "message" + "s" * many, detail

    def stamp(self, msgtype: str) -> str | None:
        """Where the sender's stamp is in a message: `header.stamp` or `stamp`; None where it has none."""
        for name, kind, detail in self.fields(msgtype):
            if name == "header" and kind == "message" and detail == "std_msgs/msg/Header":
                return "header.stamp"
            if name == "stamp" and kind == "time":
                return "stamp"
        return None


class Missing:
    """What has no column, and why; and in which order the names of an array's entries first came."""

    def __init__(self) -> None:
        self.why: dict[str, str] = {}
        self.order: dict[str, tuple[str, ...]] = {}


def columns(
    objects: list[Any], msgtype: str, types: Types, prefix: str, missing: Missing
) -> Iterator[tuple[str, NDArray[Any]]]:
    """Columns of a list of messages of one type, (T,) or (T, k); `missing` takes what has no column, and why."""
    fields = types.fields(msgtype)
    labels = next((f for f, kind, _ in fields if kind == "texts" and f in _NAMES), None)
    names = [tuple(n) for n in map(attrgetter(labels), objects)] if labels else None
    for field, kind, detail in fields:
        values, name = list(map(attrgetter(field), objects)), prefix + field
        if kind == "number":
            yield name, np.array(values)
        elif kind == "time":
            yield name, np.array([v.sec + v.nanosec * 1e-9 for v in values])
        elif kind == "numbers":
            yield from _numbers(name, values, names, missing)
        elif kind == "message":
            yield from columns(values, detail, types, f"{name}.", missing)
        elif kind == "messages":
            lengths = {len(v) for v in values}
            if len(lengths) > 1 or max(lengths) > LONGEST_ARRAY:
                missing.why[name] = _unfit(lengths)
                continue
            for i in range(max(lengths)):
                yield from columns([v[i] for v in values], detail, types, f"{name}[{i}].", missing)


def _numbers(
    name: str, values: list[Any], labels: list[tuple[str, ...]] | None, missing: Missing
) -> Iterator[tuple[str, NDArray[Any]]]:
    """An array in each message: (T, k) where its length never changes, and a column for each name that it has."""
    lengths = {len(v) for v in values}
    fixed = len(lengths) == 1 and 0 < max(lengths) <= LONGEST_ARRAY
    steady = labels is None or set(labels) == {missing.order.setdefault(name, labels[0])}
    if fixed and steady:
        yield name, np.stack(values)
    elif max(lengths) > 0:
        missing.why[name] = _unfit(lengths) if steady else "the order of its names changes: address it by name"
    if labels is None or max(lengths) > LONGEST_ARRAY:
        return
    for label in dict.fromkeys(n for row in labels for n in row):
        rows = [
            float(v[row.index(label)]) if len(v) == len(row) and label in row else np.nan
            for v, row in zip(values, labels, strict=True)
        ]
        if np.isfinite(rows).any():
            yield f"{name}[{label}]", np.array(rows)


def _unfit(lengths: Iterable[int]) -> str:
    longest, shortest = max(lengths), min(lengths)
    if longest != shortest:
        return f"its length changes, from {shortest} to {longest}"
    return f"it is {longest} long, and arrays over {LONGEST_ARRAY} are left out"


def joined(chunks: list[tuple[Columns, int]]) -> tuple[Columns, dict[str, str]]:
    """Chunks end to end; NaN where a chunk has no column of a name; (T, k) must have one k throughout."""
    joined: Columns = {}
    lost: dict[str, str] = {}
    for name in dict.fromkeys(n for columns, _ in chunks for n in columns):
        parts = [columns.get(name) for columns, _ in chunks]
        widths = {p.shape[1:] for p in parts if p is not None}
        if len(widths) > 1 or (widths != {()} and any(p is None for p in parts)):
            lost[name] = "its length changes"
            continue
        filled = [np.full(n, np.nan) if p is None else p for p, (_, n) in zip(parts, chunks, strict=True)]
        joined[name] = np.concatenate(filled)
    return joined, lost
