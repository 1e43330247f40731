"""Rows {name, value, unit, baseline, goal, holds, seeds, low, high, n} of many trials, and the same as a table."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .plan import ROBOTS
from .row import Estimate, Row, clean
from .score import share_within

BINS = ((0.0, 1.3), (1.3, 3.0), (3.0, 10.0), (10.0, math.inf))  # of X / X_null
SETTLED = ("explained", "nothing missing")  # verdicts
_Z = 1.959964  # of a 95 % interval


def wilson(hits: int, of: int) -> tuple[float, float]:
    """95 % interval of a share: Wilson, J. Am. Stat. Assoc. 22 (1927)."""
    if of == 0:
        return 0.0, 1.0
    share, z2 = hits / of, _Z**2 / of
    middle, half = share + z2 / 2, _Z * math.sqrt(share * (1 - share) / of + z2 / (4 * of))
    return max(0.0, (middle - half) / (1 + z2)), min(1.0, (middle + half) / (1 + z2))


class Summary:
    """Collects rows; `holds` is None where there is no goal or nothing was tried."""

    def __init__(self, seed: int) -> None:
        self.seed, self.rows = seed, []

    def value(
        self, name: str, value: float, unit: str, of: Sequence[Row], *, baseline: float | None = None, goal: str = "",
        holds: bool | None = None, interval: tuple[float, float] | None = None,
    ) -> None:  # fmt: skip
        """One figure over some trials."""
        low, high = interval or (math.nan, math.nan)
        row = {"name": name, "value": value, "unit": unit, "baseline": baseline, "goal": goal, "holds": holds}
        row |= {"low": low, "high": high, "n": len(of), "seeds": [self.seed, *(r.seed for r in of)]}
        self.rows.append(clean(row))

    def share(
        self, name: str, hits: int, count: int, of: Sequence[Row], *, least: float | None = None,
        most: float | None = None, baseline: float | None = None,
    ) -> None:  # fmt: skip
        """A share with its interval; nothing where there is nothing to count."""
        if not count:
            return
        value = hits / count
        goal = f">= {least:.2f}" if least is not None else f"<= {most:.2f}" if most is not None else ""
        holds = None
        if goal:
            holds = (least is None or value >= least - 1e-9) and (most is None or value <= most + 1e-9)
        name = f"{name} ({hits} of {count})"
        self.value(name, value, "1", of, baseline=baseline, goal=goal, holds=holds, interval=wilson(hits, count))


def summarise(rows: Sequence[Row], seed: int) -> list[dict[str, Any]]:
    """All figures that the trials allow."""
    out = Summary(seed)
    for robot in ROBOTS:
        mine = [r for r in rows if r.robot == robot]
        _singles(out, robot, [r for r in mine if r.group == "single"])
    _pairs(out, [r for r in rows if r.group == "pair"])
    _outside(out, [r for r in rows if r.group == "outside"])
    _nulls(out, [r for r in rows if r.group == "null"])
    _parameters(out, rows)
    for robot in ROBOTS:
        times = [r for r in rows if r.robot == robot]
        if times:
            _time(out, robot, times)
        if whole := [r for r in times if np.isfinite(r.cpu)]:
            out.value(f"{robot}: the whole trial, median", _median(r.cpu for r in whole), "core-s", whole)
    return out.rows


def _time(out: Summary, robot: str, rows: Sequence[Row]) -> None:
    """The goal is of two free cores. A trial has the cores it is given, often one and shared: above says nothing."""
    seconds, goal = _median(r.seconds for r in rows), ROBOTS[robot].seconds
    out.value(
        f"{robot}: the loop, median a trial", seconds, "s", rows, goal=f"<= {goal:g} s on two free cores",
        holds=True if seconds <= goal else None,
    )  # fmt: skip


def _median(values: Any) -> float:
    return float(np.median(list(values)))


def _right(rows: Sequence[Row]) -> list[Row]:
    return [r for r in rows if r.outcome == "right"]


def _singles(out: Summary, robot: str, rows: Sequence[Row]) -> None:
    if not rows:
        return
    right = _right(rows)
    named = [r for r in rows if r.sindy]
    sindy = sum(bool(r.sindy["right"]) for r in named) / len(named) if named else 0.0  # psi alone names nothing
    goal = ROBOTS[robot].goal
    out.share(f"{robot}: named right", len(right), len(rows), rows, least=goal, baseline=sindy)
    for low, high in BINS:
        part = [r for r in rows if low <= r.ratio < high]
        out.share(f"{robot}: named right, X/X_null {low:g} to {high:g}", len(_right(part)), len(part), part)
    for family in ROBOTS[robot].named:
        part = [r for r in rows if r.families == [family]]
        out.share(f"{robot}: named right, {family}", len(_right(part)), len(part), part)
    wrong = [r for r in rows if r.outcome == "wrong"]
    out.share(f"{robot}: something claimed that is not there", len(wrong), len(rows), rows)
    if not right:
        return
    out.share(f"{robot}: class of at most two", sum(r.class_size <= 2 for r in right), len(right), right)
    near = sum(r.errors["after"] <= 1.10 for r in right)
    psi = sum(r.errors["psi only"] <= 1.10 for r in right) / len(right)
    out.share(
        f"{robot}: error after / oracle's at most 1.10, of right cases",
        near,
        len(right),
        right,
        least=0.9,
        baseline=psi,
    )
    for stage in ("after", "psi only", "nominal", "sysid", "network"):
        of = [r for r in right if stage in r.errors]
        if of:
            out.value(f"{robot}: error / oracle's, median, {stage}", _median(r.errors[stage] for r in of), "1", of)


def _pairs(out: Summary, rows: Sequence[Row]) -> None:
    out.share("pairs: both named, nothing else", len(_right(rows)), len(rows), rows, least=0.75)
    for robot in ROBOTS:
        part = [r for r in rows if r.robot == robot]
        out.share(f"pairs: {robot}", len(_right(part)), len(part), part)
    for low, high in BINS:
        part = [r for r in rows if low <= r.ratio < high]
        out.share(f"pairs: the weaker at X/X_null {low:g} to {high:g}", len(_right(part)), len(part), part)
    half = sum(r.outcome == "half" for r in rows)
    out.share("pairs: one named, nothing else", half, len(rows), rows)


def _outside(out: Summary, rows: Sequence[Row]) -> None:
    count: Callable[[str], int] = lambda outcome: sum(r.outcome == outcome for r in rows)  # noqa: E731
    out.share("outside the library: claimed wrongly", count("wrong"), len(rows), rows, most=0.1)
    out.share("outside the library: said so, coordinate right", count("right"), len(rows), rows, least=0.8)
    out.share("outside the library: said so, at another place", count("elsewhere"), len(rows), rows)
    out.share("outside the library: silent", count("silent"), len(rows), rows, most=0.0)
    for family in dict.fromkeys(r.families[0] for r in rows):
        part = [r for r in rows if r.families == [family]]
        out.share(f"outside the library: {family}, coordinate right", len(_right(part)), len(part), part)
    for low, high in BINS:
        part = [r for r in rows if low <= r.ratio < high]
        name = f"outside the library: coordinate right, X/X_null {low:g} to {high:g}"
        out.share(name, len(_right(part)), len(part), part)


def _nulls(out: Summary, rows: Sequence[Row]) -> None:
    """2 of 124, and as many of fewer as cannot be told from that: a Poisson mean of n 2 / 124, its 95 % quantile."""
    if not rows:
        return
    false = sum(r.false_claims > 0 for r in rows)
    allowed = 2 if len(rows) >= 124 else int(np.ceil(len(rows) * 2 / 124))
    interval = tuple(len(rows) * v for v in wilson(false, len(rows)))
    out.value(
        f"false claims in {len(rows)} nulls", false, "trials", rows, goal=f"<= {allowed}", holds=false <= allowed,
        interval=(interval[0], interval[1]),
    )  # fmt: skip
    loud = sum(r.verdict != "nothing missing" for r in rows)
    out.share("nulls: anything but `nothing missing`", loud, len(rows), rows)


def _parameters(out: Summary, rows: Sequence[Row]) -> None:
    right = [r for r in _right(rows) if r.group in ("single", "pair")]
    found: list[Estimate] = [e for r in right for e in r.effect]
    covered = sum(e.covered for e in found)
    if found:
        share = covered / len(found)
        few = 0.99 ** len(found) > 0.05  # all of so few covered cannot be told from 99 %
        out.value(
            f"effects' parameters in their 95 % interval ({covered} of {len(found)})", share, "1", right,
            goal="0.85 to 0.99", holds=share >= 0.85 and (share <= 0.99 or few), interval=wilson(covered, len(found)),
        )  # fmt: skip
    out.share("effects' parameters within 5 %", *share_within(found, 0.05), right, least=1.0)
    off = [e.off for e in found if math.isfinite(e.off)]
    if off:
        out.value("effects' parameters, relative error, median", _median(off), "1", right)
    for what, settled in (("nothing is missing any more", True), ("something is, so that they need not be", False)):
        part = [r for r in _right(rows) if (r.verdict in SETTLED) == settled]
        psi = [e for r in part for e in r.psi]
        out.share(f"psi in its 95 % interval, where {what}", sum(e.covered for e in psi), len(psi), part)
    _foretold(out, rows)


def _foretold(out: Summary, rows: Sequence[Row]) -> None:
    """Of single effects and pairs alone: the table has no row of what is outside the library, so it foretells none."""
    misses = [r for r in rows if r.foretold is not None]
    for of, part in (("", misses), (", of pairs", [r for r in misses if r.group == "pair"])):
        foretold = sum(bool(r.foretold) for r in part)
        name = f"misses that the identifiability table foretold{of}"
        out.share(name, foretold, len(part), part, least=None if of else 0.9)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The figures as text."""
    marks = {True: "holds", False: "MISSED", None: ""}
    lines = [f"{'':74s} {'value':>8s} {'95 % interval':>15s} {'baseline':>9s}  goal"]
    for r in rows:
        base = "" if r["baseline"] is None else f"{r['baseline']:.3f}"
        between = "" if r["low"] is None else f"{r['low']:.2f} to {r['high']:.2f}"
        lines.append(f"{r['name']:74s} {r['value']:8.3f} {between:>15s} {base:>9s}  {r['goal']} {marks[r['holds']]}")
    return "\n".join(lines)
