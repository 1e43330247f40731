"""What a reader should know: parameters that left their prior or slide together, claims that are just the simplest."""

from collections.abc import Sequence
from typing import Any

from nfc_gym.measured import gauge
from nfc_gym.measured.fit import Fit
from nfc_gym.measured.ranking import Round
from nfc_gym.measured.wording import listed, number, quantity, unit


def on_parameters(fitted: Fit, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Findings, as `report.json` holds them: {"kind": "left_prior" | "gauge", "text": a sentence or two}.

    Args:
      fitted: the extended model, fitted.
      rows: its parameters (`verdict.parameter_rows`).
    """
    out = []
    for p, row in zip(fitted.plant.space.parameters, rows, strict=True):
        if row["left_prior"]:
            upper = p.high - row["estimate"] < row["estimate"] - p.low
            bound, side = (p.high, "more") if upper else (p.low, "less")
            span = f"{number(p.low)} to {number(p.high)} {unit(p.unit)}".rstrip()
            text = (
                f"{p.name} left its prior: the logs ask for {quantity(bound, p.unit)} or {side}, where {span} was "
                "declared. Widen the range if that is plausible; if it is not, the parameter stands in for something "
                "that the model lacks."
            )
            out.append({"kind": "left_prior", "text": text})
    return out + [{"kind": "gauge", "text": text} for text in gauge.said(fitted)]


def on_simplicity(claimed: Sequence[dict[str, Any]], rounds: Sequence[Round]) -> list[dict[str, Any]]:
    """Findings on claims that are named for their simplicity alone, see `Round.possible`."""
    crowds = {i: r.possible for r in rounds for i in r.accepted if r.possible}
    return [
        {
            "kind": "simplest",
            "text": f"{row['id']} is named since it needs the fewest numbers: {listed(crowds[row['id']])} explain "
            "these logs as well with more, and are too many to be listed as its equivalents.",
        }
        for row in claimed
        if row["id"] in crowds
    ]
