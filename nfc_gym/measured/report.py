"""`report.html`: one self-contained page that a person can read in a minute.

The figures are inline SVG (`charts`), the words come from `story`, the layout from `templates`; nothing is loaded from
outside, and the same report gives the same page.
"""

import math
from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from nfc_gym.measured import charts, story, wording
from nfc_gym.measured.charts import Series
from nfc_gym.measured.wording import finite

Row = dict[str, Any]
STAGES = {"nominal": "as given", "calibrated": "calibrated", "extended": "effects added"}
_SHORT = 12  # rows or figures beyond which the rest is folded away
_STRIPS = 24  # logs whose misfit is drawn through time
_CELLS = 60  # cells of such a strip


def render(report: Row, shown: Row) -> str:
    """The page for a report (as in `report.json`) and the data of its pictures (see `details.details`).

    Values that are missing, None or not finite are shown as a dash.
    """
    stages = [s for s in STAGES if s != "extended" or story.added(report)]
    misfit = shown.get("misfit") or {}
    return page(
        "report.html.j2",
        report=report,
        verdict=story.verdict_of(report),
        headline=story.headline(report),
        sentences=[s for s in (story.error_sentence(report), story.certainty(report)) if s],
        notices=story.notices(report),
        stages={s: STAGES[s] for s in stages},
        predicted={s: STAGES[s] for s in stages if s != "nominal"},
        error_charts=_error_charts(report.get("error") or {}, stages),
        error_rows=_error_rows(report.get("error") or {}),
        chi2=_chi2(report.get("chi2") or {}, stages),
        chi2_bound=finite((report.get("chi2") or {}).get("null_95")),
        instant=(report.get("error") or {}).get("horizons_s") == [0.0],
        traces=[_trace(t, stages) for t in shown.get("traces") or []],
        effects=[_effect(e, report["effects"]) for e in report.get("effects") or []],
        proposals=[_effect(e, report["proposals"]) for e in report.get("proposals") or []],
        parameters=[_parameter(p) for p in report.get("parameters") or []],
        posterior=story.believed(report.get("posterior")),
        structure=story.suspected(report),
        rounds=[_round(r) for r in report.get("rounds") or []],
        places=_misfit_rows(misfit, "place", stages),
        logs_misfit=_misfit_rows(misfit, "log", stages),
        strips=_strips(misfit, stages),
        maps=_maps(shown.get("maps") or {}, stages),
        short=_SHORT,
    )


def render_summary(summary: Row) -> str:
    """The page over the folds of a run that rotates (as in its `report.json`), with links to `<fold>/report.html`."""
    folds = [_fold(name, r) for name, r in (summary.get("folds") or {}).items()]
    tally: dict[str, int] = {}
    for f in folds:
        tally[f["verdict"].word] = tally.get(f["verdict"].word, 0) + 1
    return page(
        "summary.html.j2",
        report=summary,
        folds=folds,
        headline="; ".join(f"{word} in {n} of {len(folds)} folds" for word, n in tally.items()),
        found=list((summary.get("effects_found_in") or {}).items()),
    )


def page(template: str, **values: Any) -> str:
    """One of `templates` with its values: a self-contained page."""
    return _templates().get_template(template).render(**values)


@cache
def _templates() -> Environment:
    """The pages' templates, each compiled once: that takes longer than to fill it in."""
    # autoescape for every file: `select_autoescape` would pass over names that end in .j2
    env = Environment(
        loader=PackageLoader("nfc_gym.measured", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    words = (wording.number, wording.quantity, wording.plain, wording.percent, wording.unit, wording.counted)
    env.filters |= {f.__name__: f for f in words}
    return env


def _values(row: Row, stage: str) -> list[Any]:
    return list(row.get(stage) or [])


def _error_charts(error: Row, stages: Sequence[str]) -> list[Row]:
    """A figure for each group: curves over the horizons, bars where there is one horizon."""
    horizons = error.get("horizons_s") or []
    out = []
    for group, row in (error.get("groups") or {}).items():
        unit = wording.unit(row.get("unit"))
        known = [i for i, _ in enumerate(horizons) if any(story.value_at(row.get(s), i) is not None for s in stages)]
        if len(known) > 1:
            curves = [Series(STAGES[s], s, horizons, _values(row, s)) for s in stages]
            curves.append(Series("noise floor", "floor", horizons, _values(row, "noise_floor")))
            figure, at = charts.error_chart(group, unit, curves), ""
        else:
            i = known[0] if known else 0
            bars = [(STAGES[s], s, story.value_at(row.get(s), i)) for s in stages]
            figure = charts.bar_chart(group, unit, bars, story.value_at(row.get("noise_floor"), i))
            at = story.ahead(story.value_at(horizons, i))
        out.append({"title": f"{group}{at}", "figure": figure})
    return out


def _error_rows(error: Row) -> list[Row]:
    """The same errors as numbers: a row for each group and horizon."""
    stages = (*STAGES, "noise_floor")
    return [
        {"group": group, "unit": row.get("unit"), "horizon": h} | {s: story.value_at(row.get(s), i) for s in stages}
        for group, row in (error.get("groups") or {}).items()
        for i, h in enumerate(error.get("horizons_s") or [])
        if any(story.value_at(row.get(s), i) is not None for s in stages)
    ]


def _chi2(chi2: Row, stages: Sequence[str]) -> list[Row]:
    """Chi-squared of each model and of a perfect one; bars show the root, which is the misfit in noise widths."""
    rows = [(STAGES[s], s, finite(chi2.get(s))) for s in stages]
    rows.append(("a perfect model", "floor", finite(chi2.get("null"))))
    top = math.sqrt(max([v for *_, v in rows if v is not None and v >= 0], default=0.0))
    return [
        {
            "name": name,
            "value": v,
            "root": _root(v),
            "meter": charts.meter(_root(v), top, cls),
        }
        for name, cls, v in rows
    ]


def _root(value: Any) -> float | None:
    x = finite(value)
    return None if x is None or x < 0 else math.sqrt(x)


def _trace(trace: Row, stages: Sequence[str]) -> Row:
    time = trace.get("time") or []
    curves = [Series(STAGES[s], s, time, _values(trace, s)) for s in stages if s != "nominal"]
    sampled = trace.get("sample_time") or time
    curves.append(Series("measured", "measured", sampled, _values(trace, "measured"), dots=True))
    title, unit = str(trace.get("title", "")), wording.unit(trace.get("unit"))
    return {"title": title, "figure": charts.trace_chart(f"{title}: measured and predicted", unit, curves)}


def _effect(effect: Row, effects: Sequence[Row]) -> Row:
    rows = []
    for name, p in (effect.get("parameters") or {}).items():
        value, span = wording.interval(p.get("value"), p.get("low"), p.get("high"))
        span = "given" if p.get("given") else span
        what, at, place = str(name).partition("@")
        label = what.replace("_", " ") + (f" at {place}" if at else "")
        rows.append({"name": label, "value": value, "interval": span, "unit": p.get("unit")})
    share = effect.get("share_of_excess")
    return {
        "id": effect.get("id"),
        "sentence": effect.get("sentence") or story.what(effect),
        "nearest": bool(effect.get("nearest")),
        "alike": effect.get("alike") or [],
        "mended_by": wording.smooth(effect["mended_by"]) if "mended_by" in effect else "",
        "may_be_none": bool(effect.get("may_be_none")),
        "share": share,
        "meter": charts.meter(share, 1.0, "extended"),
        "equivalents": story.rivals_of(effect, effects),
        "parameters": rows,
    }


def _parameter(p: Row) -> Row:
    value, span = wording.interval(p.get("estimate"), p.get("low"), p.get("high"))
    change = wording.change(p.get("nominal"), p.get("estimate"))
    told = p.get("inferred") or {}
    median, inferred = wording.interval(told.get("median"), told.get("low"), told.get("high"))
    return p | {"value": value, "interval": span, "change": change, "inferred": f"{median} ({inferred})"}


def _round(r: Row) -> Row:
    accepted = r.get("accepted") or []
    taken = [str(i) for i in accepted] if isinstance(accepted, list) else [str(accepted)]
    label = " + ".join(taken)
    rows = [
        {k: c.get(k) for k in ("id", "gain_fit", "gain_select", "gain_select_low", "generic", "sentence")}
        | {"outcome": _outcome(c, label, r), "accepted": c.get("id") == label}
        for c in r.get("ranking") or []
    ]
    # A plainer law that does what the best-ranked one does is refitted after the ranking, and has no row of its own.
    plainer = bool(taken and rows) and not any(row["accepted"] for row in rows)
    return {"accepted": taken, "plainer": plainer, "reason": r.get("reason") or "", "rows": rows}


def _outcome(candidate: Row, label: str, r: Row) -> str:
    """Why a candidate was taken or left, from what its round decided; `label` is what that accepted, or empty."""
    gain, low = finite(candidate.get("gain_select")), finite(candidate.get("gain_select_low"))
    if label and candidate.get("id") == label:
        return "accepted"
    if candidate.get("id") in (r.get("possible") or []):
        return "does as well with more numbers, as too many do: the accepted one is the simplest"
    if candidate.get("id") in (r.get("equivalents") or []):
        return "cannot be told from the accepted one, which is as plain or plainer"
    if gain is not None and gain <= 0:
        return "no gain on unseen logs"
    if low is not None and low <= 0:
        return "gain on what it was not fitted to is not sure: lower bound not above zero"
    if not label:
        return "a gain too small to name, or no larger than chance gives"
    taken = next((c for c in r.get("ranking") or [] if c.get("id") == label), None)
    if taken is not None and _total(candidate) >= _total(taken):
        return "gains no more than a plainer one would by chance: the accepted one is preferred"
    return "gains less than the accepted one"


def _total(candidate: Row) -> float:
    return (finite(candidate.get("gain_fit")) or 0.0) + (finite(candidate.get("gain_select")) or 0.0)


def _misfit_rows(misfit: Row, by: str, stages: Sequence[str]) -> list[Row]:
    """Misfit in noise widths by place or by log, calibrated next to extended, the worst first."""
    kept = [s for s in stages if s != "nominal"]
    values = {s: {str(k): _root(v) for k, v in ((misfit.get(s) or {}).get(by) or {}).items()} for s in kept}
    top = max([v for of in values.values() for v in of.values() if v is not None], default=0.0)
    names = sorted(values.get("calibrated") or {}, key=lambda n: (-(values["calibrated"][n] or 0.0), n))
    cell = lambda n, s: {"value": values[s].get(n), "meter": charts.meter(values[s].get(n), top, s)}  # noqa: E731
    return [{"name": n, "cells": [cell(n, s) for s in kept]} for n in names]


def _strips(misfit: Row, stages: Sequence[str]) -> Row:
    """Misfit through time, a strip for each log: the logs that calibration leaves worst."""
    kept = [s for s in stages if s != "nominal"]
    times = {s: _by_log((misfit.get(s) or {}).get("time") or {}) for s in kept}
    first = times["calibrated"]
    order = sorted(first, key=lambda n: (-max((v or 0.0) for _, v in first[n]), n))
    every = [v for of in times.values() for rows in of.values() for _, v in rows if v is not None]
    top = max(every, default=1.0)
    end = max((t for rows in first.values() for t, _ in rows), default=0.0)
    gaps = [b[0] - a[0] for rows in first.values() for a, b in pairwise(rows) if b[0] > a[0]]
    step = min(gaps, default=1.0)
    rows = [{"log": n, "figures": [_strip(n, times[s].get(n, []), end + step, step, top) for s in kept]} for n in order]
    return {"rows": rows[:_STRIPS], "left_out": max(len(rows) - _STRIPS, 0), "end": end + step, "worst": _root(top)}


def _maps(maps: Row, stages: Sequence[str]) -> Row:
    """Misfit over the state: shares by degree of freedom, curves over position and speed, and the ground's map."""
    kept = [s for s in stages if s != "nominal"]
    shares = maps.get("degrees") or {}
    top = max((finite(s) or 0.0 for s in shares.values()), default=0.0)
    places = [{"name": n, "share": s, "meter": charts.meter(s, top, "calibrated")} for n, s in shares.items()]
    lines = [
        {
            "title": line.get("title", ""),
            "figure": charts.misfit_chart(
                f"misfit {line.get('title', '')}",
                wording.unit(line.get("unit")),
                [Series(STAGES[s], s, line.get("x") or [], [_root(v) for v in _values(line, s)]) for s in kept],
            ),
        }
        for line in maps.get("lines") or []
    ]
    grid = maps.get("grid") or {}
    x, y = (grid.get(k) or [] for k in "xy")
    every = [finite(v) or 0.0 for s in kept for row in grid.get(s) or [] for v in row]
    most = max(every, default=1.0)
    grids = [
        {"title": STAGES[s], "figure": charts.heat_grid(f"misfit over the ground, {STAGES[s]}", x, y, grid[s], most)}
        for s in kept
        if x and y and grid.get(s)
    ]
    return {"places": places, "lines": lines, "grids": grids}


def _by_log(time: Row) -> dict[str, list[tuple[float, float | None]]]:
    out: dict[str, list[tuple[float, float | None]]] = {}
    columns = (time.get(k) or [] for k in ("log", "seconds", "value"))
    for log, second, value in zip(*columns, strict=False):
        if finite(second) is not None:
            out.setdefault(str(log), []).append((float(second), finite(value)))
    return {log: sorted(rows, key=lambda r: r[0]) for log, rows in out.items()}


def _strip(log: str, rows: Sequence[tuple[float, float | None]], end: float, step: float, top: float) -> Markup:
    """Cells of equal length; each holds the mean of the blocks that start in it."""
    width = max(end / _CELLS, step)
    cells: dict[int, list[float]] = {}
    for t, v in rows:
        if v is not None:
            cells.setdefault(int(t / width), []).append(v)
    drawn = []
    for i, values in sorted(cells.items()):
        mean = sum(values) / len(values)
        tip = f"from {wording.number(i * width)} s: {wording.number(_root(mean))}"
        drawn.append((i * width, min((i + 1) * width, end), mean, tip))
    return charts.heat_strip(f"misfit through time of {log}", drawn, end, top)


def _fold(name: str, r: Row) -> Row:
    chi2 = r.get("chi2") or {}
    after = "extended" if story.added(r) else "calibrated"
    errors = [
        {"group": c.group, "unit": c.unit, "before": c.calibrated, "after": getattr(c, after), "floor": c.floor}
        for c in story.changes(r)
    ]
    return {
        "name": name,
        "verdict": story.verdict_of(r),
        "effects": r.get("effects") or [],
        "calibrated": chi2.get("calibrated"),
        "after": chi2.get(after),
        "bound": chi2.get("null_95"),
        "errors": errors,
    }
