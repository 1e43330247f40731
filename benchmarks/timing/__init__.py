"""Rows of a benchmark's table, and contestants that take turns against a clock."""

import multiprocessing
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

SEED = 0
_CLOCKS: list[Callable[[], float]] = [time.perf_counter]  # the last one is read


@dataclass
class Row:
    """One figure with what it is compared to; `holds` is None where there is no goal."""

    name: str
    value: float
    unit: str
    baseline: float | None = None
    goal: str | None = None
    holds: bool | None = None
    seeds: tuple[int, ...] = (SEED,)


class Table:
    """Collects rows and prints each as it comes."""

    def __init__(self) -> None:
        self.rows: list[Row] = []

    def add(
        self, name: str, value: float, unit: str, *, baseline: float | None = None, at_least: float | None = None,
        at_most: float | None = None, seeds: tuple[int, ...] = (SEED,),
    ) -> None:  # fmt: skip
        goal = f">= {at_least:g}" if at_least is not None else f"<= {at_most:g}" if at_most is not None else None
        holds = None if goal is None else bool(value >= at_least if at_least is not None else value <= at_most)
        self.rows.append(Row(name, float(value), unit, baseline, goal, holds, seeds))
        compared = "" if baseline is None else f"   (baseline {baseline:.4g})"
        verdict = "" if goal is None else f"   goal {goal}: {'holds' if holds else 'FALLS SHORT'}"
        print(f"{name:68} {value:10.4g} {unit}{compared}{verdict}", flush=True)


def processor_time() -> float:
    """Seconds of processor time of this process and its live children."""
    own, tick = time.process_time(), os.sysconf("SC_CLK_TCK")
    for child in multiprocessing.active_children():
        fields = Path(f"/proc/{child.pid}/stat").read_text().rpartition(")")[2].split()
        own += (int(fields[11]) + int(fields[12])) / tick
    return own


def race(contestants: dict[str, Callable[[], None]], turns: int, before: Callable[[], None] = lambda: None) -> dict:
    """Median seconds of each contestant over `turns` turns, each turn in another order; `before` runs untimed."""
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    names, clock = list(contestants), _CLOCKS[-1]
    for turn in range(turns + 1):
        for name in names[turn % len(names) :] + names[: turn % len(names)]:
            before()
            began = clock()
            contestants[name]()
            if turn:  # the first turn warms up
                seconds[name].append(clock() - began)
    return {name: statistics.median(s) for name, s in seconds.items()}


def use_clock(name: str) -> None:
    """Read the time that passes (`wall`) or processor time (`cpu`) from now on."""
    _CLOCKS.append(processor_time if name == "cpu" else time.perf_counter)


def clock() -> Callable[[], float]:
    """What times are read from now on."""
    return _CLOCKS[-1]
