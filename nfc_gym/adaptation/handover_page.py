"""`report.html` of an adaptation: what it was worth, and the curve of learning; one page that loads nothing."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from nfc_gym.measured import charts, wording
from nfc_gym.measured.charts import Series
from nfc_gym.measured.report import page

_WORLDS = {"nominal": "nominal model", "extended": "extended model", "world": "true world"}


class Verdict(NamedTuple):
    """What the badge shows."""

    cls: str
    sign: str
    word: str


def render(report: Mapping[str, Any]) -> str:
    """The page for a report, as in `report.json`."""
    main = report["returns"][report["measured_in"]]
    effects = [e for e in report["effects"] if e["acts"]]
    return page(
        "adapted.html.j2",
        report=report,
        verdict=_verdict(main["gain"]),
        headline=_headline(report, main),
        rows=[_world(name, report["returns"][name]) for name in _WORLDS if name in report["returns"]],
        success="success" in main["after"],
        curve=_curve(report["curve"]),
        kept=report["curve"][report["kept"]],
        effects=[_effect(e) for e in effects],
        ablated=[_ablated(e, report["measured_in"]) for e in effects if "ablation" in e],
        silent=[e["id"] for e in report["effects"] if not e["acts"]],
        sizes=[s for e in report["effects"] for s in _sizes(e)],
        parameters=[p | {"shown": _span(p["estimate"], p["low"], p["high"])} for p in report["parameters"]],
    )


def _verdict(gain: Mapping[str, float]) -> Verdict:
    if gain["low"] > 0:
        return Verdict("good", "✓", "better")
    return Verdict("open", "✗", "worse") if gain["high"] < 0 else Verdict("part", "≈", "no difference shown")


def _headline(report: Mapping[str, Any], main: Mapping[str, Any]) -> str:
    before, after = (wording.number(main[k]["return"]["mean"], 4) for k in ("before", "after"))
    where = _WORLDS[report["measured_in"]]
    return f"In the {where} the return went from {before} to {after}: {_plus(main['gain'])} an episode"


def _plus(gain: Mapping[str, float]) -> str:
    value, span = wording.interval(gain["mean"], gain["low"], gain["high"])
    return f"{'+' if gain['mean'] > 0 else ''}{value} ({span})"


def _span(value: float, low: float, high: float) -> str:
    shown, span = wording.interval(value, low, high)
    return f"{shown} ({span})"


def _of(figure: Mapping[str, float]) -> str:
    return _span(figure["mean"], figure["low"], figure["high"])


def _world(name: str, row: Mapping[str, Any]) -> dict[str, str]:
    shown = {k: _of(row[k]["return"]) for k in ("before", "after")}
    if "success" in row["after"]:
        shown |= {f"{k}_success": wording.percent(row[k]["success"]["mean"]) for k in ("before", "after")}
    return {"name": _WORLDS[name], "gain": _plus(row["gain"]), **shown}


def _curve(points: list[dict[str, Any]]) -> Any:
    steps = [p["steps"] for p in points]
    styles = {"mean": "extended", "low": "floor", "high": "floor"}
    lines = [Series(f"return, {k}", cls, steps, [p["return"][k] for p in points]) for k, cls in styles.items()]
    return charts.curve_chart("return while learning", "control steps", "return", lines)


def _effect(e: Mapping[str, Any]) -> dict[str, Any]:
    after, before = e["returns"]["after"], e["returns"]["before"]
    return {
        "id": e["id"], "sentence": e["sentence"], "with": _of(after["with"]["return"]),
        "without": _of(after["without"]["return"]), "cost": _cost(after["cost"]), "before": _cost(before["cost"]),
    }  # fmt: skip


def _cost(cost: Mapping[str, float]) -> str:
    return _span(cost["mean"], cost["low"], cost["high"])


def _ablated(e: Mapping[str, Any], where: str) -> dict[str, str]:
    row = e["ablation"][where]
    return {"id": e["id"], "unaware": _of(row["unaware"]["return"]), "worth": _plus(row["worth"])}


def _sizes(e: Mapping[str, Any]) -> list[dict[str, str]]:
    rows = []
    for name, p in e["parameters"].items():
        shown = _span(p["value"], p["low"], p["high"])
        rows.append({"id": e["id"], "name": name.replace("_", " "), "shown": shown, "unit": p["unit"]})
    return rows
