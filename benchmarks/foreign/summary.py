"""Figures of all machines, for a file and as tables that a page can take."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from standin.score import share_within
from standin.summary import Summary

from .score import Score

GROUPS = {
    "null": "nothing hidden",
    "single": "one effect",
    "pair": "two effects",
    "outside": "outside the library",
}
FALSE = ("claimed", "wrong")  # outcomes in which something is claimed that is not there


def summarise(rows: Sequence[Score], seed: int) -> list[dict[str, Any]]:
    """{name, value, unit, baseline, goal, holds, low, high, n, seeds} of each figure; who failed counts as wrong."""
    out = Summary(seed)
    for group, words in GROUPS.items():
        mine: Any = [r for r in rows if r.group == group]
        out.share(f"{words}: right", _count(mine, "right"), len(mine), mine)
        out.share(f"{words}: something false claimed", _count(mine, *FALSE), len(mine), mine)
    right: Any = [r for r in rows if r.outcome == "right" and r.group in ("single", "pair")]
    for words, numbers in (("effects' numbers", _all(rows, "effect")), ("psi", _all(rows, "psi"))):
        out.share(f"{words} in their 95 % interval", sum(n.covered for n in numbers), len(numbers), rows)  # type: ignore[arg-type]
        out.share(f"{words} within 5 %", *share_within(numbers, 0.05), rows)  # type: ignore[arg-type]
    if right:
        after = float(np.median([r.x["extended"] / r.x["null"] for r in right]))
        before = float(np.median([r.x["calibrated"] / r.x["null"] for r in right]))
        out.value("X / X_null after, median of right ones (baseline: psi alone)", after, "1", right, baseline=before)
    every: Any = rows
    if rows:
        out.value("the loop, median", float(np.median([r.seconds for r in rows])), "s", every)
        out.value("the loop, longest", max(r.seconds for r in rows), "s", every)
    return out.rows


def _count(rows: Sequence[Score], *outcomes: str) -> int:
    return sum(r.outcome in outcomes for r in rows)


def _all(rows: Sequence[Score], which: str) -> list:
    return [n for r in rows for n in getattr(r, which)]


def by_group(rows: Sequence[Score]) -> str:
    """A table with a row for each kind of machine and one for all, in Markdown."""
    head = (
        "hidden",
        "machines",
        "right",
        "false claims",
        "failed",
        "numbers in interval",
        "psi in interval",
        "median s",
    )
    lines = [_line(head), _rule(len(head))]
    for group, words in (*GROUPS.items(), ("", "all")):
        mine = [r for r in rows if r.group == group or not group]
        if not mine:
            continue
        effect, psi = _all(mine, "effect"), _all(mine, "psi")
        cells = [words, len(mine), _count(mine, "right"), _count(mine, *FALSE), _count(mine, "failed", "timed out")]
        cells += [f"{sum(n.covered for n in v)} of {len(v)}" if v else "" for v in (effect, psi)]
        lines.append(_line([*cells, f"{np.median([r.seconds for r in mine]):.0f}"]))
    return "\n".join(lines)


def by_machine(rows: Sequence[Score]) -> str:
    """A table with a row for each machine, in Markdown; X is over that of a perfect model."""
    lines = [_line(("machine", "hidden", "outcome", "said", "X: psi alone", "X: after", "s"))]
    lines.append(_rule(7))
    for r in rows:
        said = "; ".join(r.claims) or r.verdict
        said += f", at {r.said}" if r.said else ""
        x = [f"{r.x[k] / r.x['null']:.3g}" if r.x else "" for k in ("calibrated", "extended")]
        lines.append(_line([r.name, r.hidden, r.outcome, said, *x, f"{r.seconds:.0f}"]))
    return "\n".join(lines)


def _line(cells: Sequence[object]) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


def _rule(columns: int) -> str:
    return "|" + "---|" * columns
