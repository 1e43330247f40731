"""What is expected of a proposed motion, as rows of its JSON file and as sentences."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.questions import TOLD, Visible
from nfc_gym.measured.wording import number

Array = NDArray[np.float64]


def pair_rows(pairs: Sequence[tuple[str, str]], before: Array, after: Array) -> list[dict[str, Any]]:
    """Distances in sigma of claims from their rivals, now and with the motion, (pairs,) each."""
    rows = []
    for (claim, rival), was, will in zip(pairs, map(float, before), map(float, after), strict=True):
        row = {"claim": claim, "rival": rival, "sigma_before": was, "sigma_after": will}
        rows.append(row | {"told_apart": will > TOLD})
    return rows


def pair_sentence(row: dict[str, Any]) -> str:
    """Before and after, and whether that is enough."""
    enough = "enough to tell them apart" if row["told_apart"] else f"still less than the {TOLD:g} that tells them apart"
    return (
        f"{row['claim']} and {row['rival']} lie {number(row['sigma_before'], 2)} sigma apart in the present logs, and "
        f"would lie {number(row['sigma_after'], 2)} apart with this motion: {enough}."
    )


def size_rows(effects: Sequence[Visible], before: Array, after: Array) -> list[dict[str, Any]]:
    """The smallest size of each effect that is sure to be found, now and with the motion, from distances in sigma."""
    rows = []
    for seen, was, will in zip(effects, map(float, before), map(float, after), strict=True):
        i = next(i for i, p in enumerate(seen.effect.params) if not p.shape)
        size, needed = abs(float(seen.theta[i] - seen.effect.params[i].null)), seen.ask.needed
        smallest = [size * needed / v if v > 1e-3 * needed else None for v in (was, will)]
        keys = ("smallest_detectable_before", "smallest_detectable_after")
        rows.append({"id": seen.effect.id, "unit": seen.effect.params[i].unit} | dict(zip(keys, smallest, strict=True)))
    return rows


def size_sentence(rows: Sequence[dict[str, Any]]) -> str:
    """By how much the sizes shrink, on the whole."""
    ratios = [
        r["smallest_detectable_before"] / r["smallest_detectable_after"]
        for r in rows
        if r["smallest_detectable_before"] and r["smallest_detectable_after"]
    ]
    new = sum(r["smallest_detectable_before"] is None and r["smallest_detectable_after"] is not None for r in rows)
    text = (
        f"With this motion {len(rows)} effects would show at sizes {number(float(np.median(ratios)), 2)} times smaller"
        if ratios
        else ""
    )
    shown = f"{new} that the present logs do not show at all would show" if new else ""
    return "; ".join(t for t in (text, shown) if t) + " (median)." if text or shown else "No motion shows more."
