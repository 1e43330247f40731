"""The first fit of a run: psi alone, from nominal values, or from where a posterior believes the machine to be."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured.belief import Belief
from nfc_gym.measured.bench import Bench
from nfc_gym.measured.box import box
from nfc_gym.measured.elsewhere import STARTS, hollows
from nfc_gym.measured.fit import Fit, objective
from nfc_gym.measured.metric import metric
from nfc_gym.measured.problem import Problem
from nfc_gym.measured.settle import TURNS, settle, slack
from nfc_gym.physics.rollout import Plant

Array = NDArray[np.float64]
_STARTS = 15  # draws of the posterior that are tried beside its median


def calibrate(
    problem: Problem,
    plant: Plant,
    seed: int,
    say: Callable[[str], None],
    belief: Belief | None = None,
    compare: bool = False,
) -> dict[str, Any]:
    """Fit psi, without effects.

    A belief decides where the fit begins; what is minimised, the weak pull towards nominal values included, and when it
    has converged are the same. Its draws stand in for the fits from elsewhere (`elsewhere`) that a rough problem gets
    from nominal values: both look around for a start from which least squares go down far. The fit begins at nominal
    values where these are better than all that the posterior offers: a wrong posterior costs one batch of roll-outs.

    Args:
      problem: measured blocks.
      plant: the model without effects.
      seed: of the starts elsewhere that rough problems get.
      say: progress.
      belief: of a posterior.
      compare: fit once more from nominal values, to say how much time the belief saved.

    Returns:
      `x` (d,) as a list, `seconds` that it took; with a belief `start` ("posterior" or "nominal"), `misfit` of both
      before any fitting (per number compared), and with `compare` `seconds_from_nominal`.
    """
    sigma = problem.covariance(plant, plant.null)
    tell = say if plant.space.free.any() else lambda text: None  # where nothing is free, only the metric settles

    def fitted(x: Array, alone: bool) -> Array:
        tick = lambda turn: tell(f"calibrating psi, pass {turn} of at most {TURNS}")  # noqa: E731
        found, under, extra = settle(problem, sigma, plant, x, tick=tick)
        again = lambda start: tell(f"calibrating psi from elsewhere, start {start} of {STARTS}")  # noqa: E731
        return hollows(problem, under, extra, found, seed, tick=again).x if alone else found.x

    began = time.monotonic()
    at, about = (plant.null, {}) if belief is None else _nearest(problem, sigma, plant, belief)
    x = fitted(at, about.get("start") != "posterior")
    out: dict[str, Any] = {"x": x.tolist(), "seconds": round(time.monotonic() - began, 2)} | about
    if compare and belief is not None:
        say("calibrating once more, from nominal values")
        began = time.monotonic()
        fitted(plant.null, True)
        out["seconds_from_nominal"] = round(time.monotonic() - began, 2)
    return out


def _nearest(problem: Problem, sigma: Array, plant: Plant, belief: Belief) -> tuple[Array, dict[str, Any]]:
    """Of nominal psi, the posterior's median and some draws, what fits best in the metric of the nominal one."""
    rows = np.concatenate([plant.null[None], belief.psi(plant.space)[: 1 + _STARTS]])
    limits = box(plant)
    under = metric(problem, sigma, slack(problem, sigma, plant, plant.null))
    values = objective(problem, under, limits, np.clip(limits.at(rows), limits.floor, limits.roof), plant.null)
    best, count = int(values.argmin()), max(int(problem.mask.sum()), 1)
    return limits.x(np.clip(limits.at(rows[best]), limits.floor, limits.roof), plant.null), {
        "start": "posterior" if best else "nominal",
        "misfit": {"nominal": float(values[0]) / count, "posterior": float(values[1:].min()) / count},
    }


def compared(
    bench: Bench, calibrated: dict[str, Any], extended: Fit, problem: Problem, rows: list[dict[str, Any]]
) -> dict[str, Any] | None:
    """What a report says of a belief beside the fit; each row of `parameters` that it speaks of gets `inferred`.

    Args:
      bench: with the belief; None where it has none.
      calibrated: what `calibrate` gave.
      extended: the fitted model with its effects.
      problem: what it was fitted to.
      rows: `parameters` of the report, extended here.

    Returns:
      `file`; `start`, `misfit`, `seconds` (and `seconds_from_nominal`, `seconds_saved`) of the calibration;
      `not_declared`: parameters that only the posterior speaks of; `delta_s`: what it inferred of each control step;
      `fitted_delta_s`: what the effects that were found add to the motion at the first horizon.
    """
    belief = bench.belief
    if belief is None:
        return None
    inferred = belief.inferred()
    for row in rows:
        if row["name"] in inferred:
            row["inferred"] = inferred[row["name"]]
    took = {k: v for k, v in calibrated.items() if k != "x"}
    if "seconds_from_nominal" in took:
        took["seconds_saved"] = round(took["seconds_from_nominal"] - took["seconds"], 2)
    return {
        "file": belief.file, **took, "not_declared": list(belief.beyond), "delta_s": belief.residual(),
        "fitted_delta_s": _added(extended, problem),
    }  # fmt: skip


def _added(extended: Fit, problem: Problem) -> list[dict[str, Any]]:
    """Mean and root mean square over the blocks of what the effects add to each quantity at its first horizon."""
    plant = extended.plant
    if not plant.effects:
        return []
    psi = plant.split(extended.x)[0]
    without = np.concatenate([psi, *(e.null for e in plant.effects)])
    with np.errstate(invalid="ignore"):
        bare, whole = problem.residual(plant, np.stack([without, extended.x]))
    added = np.where(problem.mask, bare - whole, np.nan)  # measured - predicted: the difference is what effects predict
    c, out = problem.columns, []
    for group, place in dict.fromkeys(zip(c.group, c.place, strict=True)):
        own = [i for i in range(len(c)) if (c.group[i], c.place[i]) == (group, place)]
        first = min(c.horizon[own])
        at = [i for i in own if c.horizon[i] == first]
        values = added[:, at][np.isfinite(added[:, at])]
        if len(values):
            out.append({
                "group": group, "place": place, "unit": c.unit[at[0]], "horizon_s": float(first),
                "mean": float(values.mean()), "rms": float(np.sqrt((values**2).mean())),
            })  # fmt: skip
    return out
