"""The tables, in Markdown, from all results of a folder."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from posteriors import paper
from posteriors.methods import BASELINES, FLOW, INPUTS, METHODS, OURS, SBI
from posteriors.metrics import mean

Results = dict[str, dict[str, Any]]
_NAMES = {
    "window": "states and actions",
    "summaries": "states, actions and physics summaries",
    "linear": "states, actions and physics summaries, from a linear start",
    "map": "states, actions and elevation map",
}
_EXTRAS = {"residuals", "motion", "axle", "rounds"}  # results that are no method's cell


def shown(pair: Iterable[float] | None, digits: int = 3) -> str:
    """A mean with its standard error."""
    if pair is None:
        return "-"
    value, error = pair
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def lines(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    out = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join(out + ["| " + " | ".join(r) + " |" for r in rows]) + "\n"


def cells(results: Results) -> dict[tuple[str, str, str, int], dict[str, Any]]:
    """Those that are methods' cells: (environment, method, inputs, seed)."""
    out = {}
    for name, found in results.items():
        parts = name.split("_")
        if len(parts) == 4 and parts[1] in METHODS and parts[2] in INPUTS:
            out[parts[0], parts[1], parts[2], int(parts[3])] = found
    return out


def table(results: Results) -> str:
    """Everything that there is, under headings."""
    every = cells(results)
    places = [r + t for r in paper.ROBOTS for t in paper.TERRAINS if any(k[0] == r + t for k in every)]
    parts = ["# Posteriors of the simulator's parameters\n"]
    for place in places:
        ceiling = results.get(f"{place}_ceiling")
        parts.append(_place(place, {k[1:]: v for k, v in every.items() if k[0] == place}, ceiling))
    parts += [_compared(every, places, results), _paper(every, places), *_others(results)]
    return "\n".join(p for p in parts if p)


def _place(place: str, found: dict[tuple[str, str, int], dict[str, Any]], ceiling: dict[str, Any] | None) -> str:
    head = ["method", "seed", "gain a parameter", "without effect", "efficiency", "coverage 50", "90", "95",
            "90 % width", "ranks", "TARP", "windows", "epochs (best)", "s", "ms"]  # fmt: skip
    out = [f"## {place}\n"]
    if ceiling:
        out.append(
            f"Fisher ceiling: {shown(ceiling['joint'])} nats a parameter, mean of {ceiling['windows']} windows without "
            f"effect ({ceiling['apart']} left out, they come apart), {ceiling['cloud']} and {ceiling['pairs']} draws "
            "of motor noise.\n"
        )
    for inputs in INPUTS:
        these = {k: v for k, v in found.items() if k[1] == inputs}
        if not these:
            continue
        rows, kinds = [], []
        for (method, _, seed), one in sorted(these.items(), key=lambda kv: (list(METHODS).index(kv[0][0]), kv[0][2])):
            name = METHODS[method].name
            if "missing" in one:
                rows.append([name, str(seed), one["missing"], *[""] * (len(head) - 3)])
                continue
            share = one["gain_without_effect"][0] / ceiling["joint"][0] if ceiling else None
            rows.append([
                name, str(seed), shown(one["gain"]), shown(one["gain_without_effect"]),
                "-" if share is None else f"{share:.2f}", *(shown(one["coverage"][c]) for c in ("0.5", "0.9", "0.95")),
                shown(one["width"]), f"{one['ranks']:.3f}", f"{one['tarp']:.3f}", str(one["trained_on"]),
                f"{one['epochs']} ({one['best']})",
                f"{one['seconds']:.0f}", f"{one['latency_ms']:.1f}",
            ])  # fmt: skip
            kinds.append([name, str(seed), *(_group(one, g, ceiling) for g in one["marginal"])])
        names = next((list(o["marginal"]) for o in these.values() if "marginal" in o), [])
        out += [f"### {place}, given {_NAMES[inputs]}\n", lines(head, rows)]
        if kinds:
            bound = [] if not ceiling else [["ceiling", "", *(shown(ceiling["groups"][g]) for g in names)]]
            out += [
                "Gain of single parameters by kind (normal fitted in probit space), windows without effect, and its "
                "share of the ceiling:\n",
                lines(["method", "seed", *names], kinds + bound),
            ]
    limit = next((o["distance_95"] for o in found.values() if "distance_95" in o), None)
    if limit:
        out.append(
            "Ranks and TARP: largest distance from uniform, for ranks that of the worst parameter; one right number "
            f"stays below {limit:.3f} in 95 of 100 cases. NPSE is judged on fewer windows.\n"
        )
    return "\n".join(out)


def _group(one: dict[str, Any], group: str, ceiling: dict[str, Any] | None) -> str:
    gained = one["marginal"][group]
    most = ceiling["groups"][group][0] if ceiling else 0.0
    return shown(gained) + (f" ({gained[0] / most:.2f})" if most > 1e-3 else "")


def _compared(every: dict[tuple[str, str, str, int], dict[str, Any]], places: list[str], results: Results) -> str:
    rows, ahead_of_sbi = [], []
    for place in places:
        ceiling = results.get(f"{place}_ceiling")
        for inputs in INPUTS:
            best = {m: _gains(every, place, m, inputs) for m in METHODS}
            ours = best[OURS]
            if not len(ours):
                continue
            row = [place, _NAMES[inputs], shown(mean(ours)), *_shares(every, place, inputs, ceiling)]
            for rivals in (BASELINES, SBI, FLOW):
                there = {m: best[m] for m in rivals if len(best[m])}
                if not there:
                    row.append("-")
                    continue
                name, top = max(there.items(), key=lambda kv: kv[1].mean())
                ahead = mean(ours[: len(top)] - top)
                row.append(f"{METHODS[name].name}: {ahead.value:+.3f} ± {ahead.error:.3f}")
                ahead_of_sbi += [ahead.value] if rivals is SBI else []
            rows.append(row)
    if not rows:
        return ""
    head = ["", "inputs", "SDE + TCN", "share of the ceiling", "90 % intervals hold",
            "ahead of the best of the paper's five", "of the better of sbi's", "of the spline flow"]  # fmt: skip
    text = "## Ours against the others\n\n" + lines(head, rows) + (
        "\nGain a parameter, nats; differences are taken window by window, on the windows that both were judged on, "
        "after a mean over seeds. Their errors are over windows: training again would give another difference.\n"
    )  # fmt: skip
    return text + (
        f"\nAhead of the better of sbi's by {shown(mean(np.array(ahead_of_sbi)))} in the mean over environments.\n"
        if ahead_of_sbi
        else ""
    )


def _shares(every: dict, place: str, inputs: str, ceiling: dict[str, Any] | None) -> list[str]:
    """Share of the ceiling that ours gain, and of the truths that their 90 % intervals hold: means over seeds."""
    ours = [v for k, v in every.items() if k[:3] == (place, OURS, inputs) and "gains" in v]
    gain, held = (
        np.mean([v[0] for v in of])
        for of in zip(*((o["gain_without_effect"], o["coverage"]["0.9"]) for o in ours), strict=True)
    )
    return ["-" if ceiling is None else f"{gain / ceiling['joint'][0]:.2f}", f"{held:.3f}"]


def _gains(every: dict, place: str, method: str, inputs: str) -> NDArray[np.float64]:
    """(windows,) mean over seeds; empty where there is no cell."""
    found = [v["gains"] for k, v in every.items() if k[:3] == (place, method, inputs) and "gains" in v]
    return np.mean(found, 0) if found else np.zeros(0)


def _paper(every: dict[tuple[str, str, str, int], dict[str, Any]], places: list[str]) -> str:
    if not places:
        return ""
    rows = []
    for method, about in METHODS.items():
        row = [about.name]
        for place in places:
            robot, terrain = (
                place[:-4] if place.endswith("Flat") else place[:-5],
                "Flat" if place.endswith("Flat") else "Rough",
            )
            theirs = paper.reported(method, robot, terrain)
            own = {k: v for k, v in every.items() if k[:2] == (place, method) and "gain" in v}
            first = min(own, key=lambda k: (list(INPUTS).index(k[2]), k[3]), default=None)  # not the best: no choice
            there = shown(own[first]["log_posterior"] if first else None, 2)
            row.append(f"{there} / {'-' if theirs is None else f'{theirs:g}'}")
        rows.append(row)
    title = "## Beside the paper's Table I: ours (the first inputs above, first seed) / the paper's\n\n"
    return f"{title}{lines(['', *places], rows)}\n{paper.CAVEAT}\n"


def _others(results: Results) -> list[str]:
    """What is no method's cell, as it is: one line a figure."""
    rows = []
    for name, found in results.items():
        if _EXTRAS.intersection(name.split("_")):  # a name may say more after it, as residuals_waves does
            rows += [[name, k, _figure(v)] for k, v in found.items()]
    return ["## More\n", lines(["", "figure", "value"], rows)] if rows else []


def _figure(value: Any) -> str:
    """As it is; a mean with as many digits as its error has zeros, three at least."""
    if not isinstance(value, list) or len(value) != 2:
        return str(value)
    small = 0 < value[1] < 1
    return shown(value, max(3, math.ceil(-math.log10(value[1]))) if small else 3)
