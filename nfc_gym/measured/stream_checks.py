"""What was done to bring a log's streams to one time, said in numbers; and clocks that cannot both be right."""

from collections.abc import Iterator

import numpy as np

from nfc_gym.measured.align import Alignment, Resampled
from nfc_gym.measured.findings import Severity, Suspicion

MANY_MISSING = 0.05  # share of rows in gaps from which on a stream is doubtful
LATE = 1e-3  # s; commands that come so much later than they were sent look like a delay of the machine
AHEAD = 1e-3  # s; stamps that lie so much after their receipt are of another clock
WANDER = 5e-3  # s; the soonest messages of ten stretches of a log differ by less, unless a clock moves
CUT = 1.0  # s that are cut off at an end, from which on it is told as a warning


def stream_notes(alignment: Alignment) -> Iterator[Suspicion]:
    """A note for each stream that was resampled, and one for what was cut off; warnings where much was lost."""
    for r in alignment.resampled:
        yield Suspicion(
            "warning" if r.missing > MANY_MISSING else "note", f"streams.{r.stream}", f"resampled {r.how} {r.shift}",
            _said(r, alignment), _advice(r, alignment),
        )  # fmt: skip
        if r.late > LATE:
            yield Suspicion(
                "warning", f"streams.{r.stream}", "late",
                f"its commands wait {1e3 * r.late:.2g} ms on average for the next row of {alignment.base}, which will "
                "look like a delay of the machine",
                f"name {r.stream}.time, or that of a faster stream, as the time column",
            )  # fmt: skip
        if r.silent:
            yield Suspicion(
                "warning", f"streams.{r.stream}", "silent",
                f"nothing for {r.silent:.3g} s, where a sample came each {1 / r.rate:.3g} s before: the last is held",
                "if samples were lost, and the machine got them, cut the recording there",
            )  # fmt: skip
    for name, seconds in alignment.wandering.items():
        if seconds > WANDER:
            yield Suspicion(
                "warning", f"streams.{name}", "wandering",
                f"its stamps move by {1e3 * seconds:.3g} ms against their receipt in the course of the log: its "
                "sender's clock drifts or was set, or messages had to wait throughout a part of it",
                f"synchronise the clocks, or name {alignment.base}.received as the time column; nothing was shifted",
            )  # fmt: skip
    for name, seconds in alignment.ahead.items():
        if seconds > AHEAD:
            yield Suspicion(
                "warning", f"streams.{name}", "ahead",
                f"stamped {1e3 * seconds:.3g} ms after it was received: its sender's clock is ahead by that or more",
                f"set the clocks, or name {alignment.base}.received as the time column; nothing was shifted",
            )  # fmt: skip
    start, end = alignment.cut
    if start or end:
        ends = [
            f"{seconds:.3g} s at the {where}, which {by} does not reach"
            for seconds, where, by in zip(alignment.cut, ("start", "end"), alignment.cutters, strict=True)
            if seconds
        ]
        severity: Severity = "warning" if max(start, end) > CUT else "note"
        yield Suspicion(
            severity,
            "streams",
            "cut",
            f"left out: {' and '.join(ends)}",
            "leave out that stream's columns to keep them",
        )


def _said(r: Resampled, alignment: Alignment) -> str:
    verb = {
        "linear": "interpolated linearly", "slerp": "interpolated by slerp", "hold": "held",
        "both": "true between true samples,",
    }[r.how]  # fmt: skip
    told = [
        f"{verb} from {r.rate:.4g} Hz ({r.clock}) to the {r.base_rate:.4g} Hz of {alignment.base} ({alignment.clock})"
    ]
    if r.kept < 1:
        told.append(f"slower than the base, so kept in the {r.kept:.2g} of its rows that are nearest to a sample")
    if np.isfinite(r.gap):
        told.append(f"{r.missing:.2%} of its rows in gaps over {1e3 * r.gap:.3g} ms (the longest {r.longest:.3g} s)")
    else:
        told.append(f"for {r.longest:.3g} s at most")
    if r.shift:
        told.append(f"its stamps shifted by {-1e3 * r.shift:.3g} ms")
    if r.repeated or r.disordered:
        told.append(f"{r.repeated} repeated and {r.disordered} disordered stamps")
    return ", ".join(told)


def _advice(r: Resampled, alignment: Alignment) -> str:
    if r.missing > MANY_MISSING:
        return "rows in gaps are not compared; look for lost messages"
    if r.how in ("linear", "slerp") and r.rate > 1.5 * r.base_rate:
        return f"name {r.stream}.time as the time column to use all its samples"
    return ""
