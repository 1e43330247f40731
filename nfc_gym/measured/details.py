"""What a report shows as pictures: measured against predicted traces, and where and when the misfit sits."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.log import Log
from nfc_gym.measured.bench import Bench
from nfc_gym.measured.shooting import RolloutProblem
from nfc_gym.measured.verdict import Models, Verified

Array = NDArray[np.float64]
_TRACES = 6
_POINTS = 400


def details(bench: Bench, v: Verified, models: Models, logs: Sequence[Log]) -> dict[str, Any]:
    """Everything the pictures need, JSON-able.

    Returns:
      `traces`: a list of {title, unit, time, measured, calibrated, extended}; `misfit`: stage ->
      {"place": {name: value}, "log": {name: value}, "time": {"log": [...], "seconds": [...], "value": [...]}} of mean
      square whitened residuals.
    """
    traces = _rollout_traces(v, models) if isinstance(v.problem, RolloutProblem) else _instant_traces(v, models)
    return {"traces": traces, "misfit": {stage: _misfit(v, stage) for stage in ("calibrated", "extended")}}


def _misfit(v: Verified, stage: str) -> dict[str, Any]:
    squares = v.squares(stage, np.nan)
    places = dict.fromkeys(
        f"{p} {g}" if not p.startswith("sensor") else p
        for p, g in zip(v.problem.columns.place, v.problem.columns.group, strict=True)
    )
    labels = [
        f"{p} {g}" if not p.startswith("sensor") else p
        for p, g in zip(v.problem.columns.place, v.problem.columns.group, strict=True)
    ]
    with np.errstate(invalid="ignore"):
        by_place = {p: _mean(squares[:, [lab == p for lab in labels]]) for p in places}
        by_log = {
            n: _mean(squares[v.problem.log_of == i])
            for i, n in enumerate(v.problem.names)
            if (v.problem.log_of == i).any()
        }
    rows = np.linspace(0, len(squares) - 1, min(len(squares), 300)).astype(int)
    return {
        "place": by_place,
        "log": by_log,
        "time": {
            "log": [v.problem.names[v.problem.log_of[r]] for r in rows],
            "seconds": [float(v.problem.time_of[r]) for r in rows],
            "value": [_mean(squares[r]) for r in rows],
        },
    }


def _mean(a: Array) -> float:
    return float(np.nanmean(a)) if np.isfinite(a).any() else 0.0


def _rollout_traces(v: Verified, models: Models) -> list[dict[str, Any]]:
    """The block of middling calibrated error, channel by channel: measured samples and both models' roll-outs."""
    problem = v.problem
    assert isinstance(problem, RolloutProblem)
    total = np.nan_to_num((v.white["calibrated"] ** 2).sum(1))
    pick = np.array([int(np.argsort(total)[int(0.75 * (len(total) - 1))])])
    one = problem.take(pick)
    time = np.arange(one.segments.steps + 1) * one.segments.dt
    keep = np.unique(np.linspace(0, len(time) - 1, min(len(time), _POINTS)).astype(int))
    curves = {
        stage: one.predict(p, x[None], one.segments, one.observers)[0]
        for stage, p, x in models.items()
        if stage != "nominal"
    }
    rows = []
    for i, o in enumerate(one.observers):
        step, measured = one.samples(i)
        for d in range(measured.shape[-1] if len(step) else 0):
            spread = np.ptp(curves["calibrated"][i][0, 0, :, d] - curves["extended"][i][0, 0, :, d])
            rows.append((spread / max(float(np.ptp(measured[:, d])), 1e-6), o, i, d, step, measured))
    rows.sort(key=lambda r: -r[0])
    return [
        {
            "title": f"{o.name}{'' if measured.shape[-1] == 1 else f'[{d}]'}, log {problem.names[one.log_of[0]]}",
            "unit": o.unit,
            "time": time[keep].tolist(),
            "sample_time": (step * one.segments.dt).tolist(),
            "measured": measured[:, d].tolist(),
            **{stage: c[i][0, 0, keep, d].tolist() for stage, c in curves.items()},
        }
        for _, o, i, d, step, measured in rows[:_TRACES]
    ]


def _instant_traces(v: Verified, models: Models) -> list[dict[str, Any]]:
    """The first stretch of a verification log: measured and predicted values."""
    problem = v.problem
    i = int(problem.log_of[0])
    t = problem.tracks[i]
    curves = {
        stage: problem.smoothed(problem.evaluate(p, x[None], [t])[0][0], t.mask)
        for stage, p, x in models.items()
        if stage != "nominal"
    }
    measured = problem.smoothed(t.measured, t.mask)
    good = np.flatnonzero(t.mask.any(1))
    rows = good[: 3 * _POINTS : max(1, len(good[: 3 * _POINTS]) // _POINTS)]
    what = list(dict.fromkeys(zip(problem.columns.place, problem.columns.unit, strict=True)))
    return [
        {
            "title": f"{what[min(d, len(what) - 1)][0]}, log {t.name}",
            "unit": what[min(d, len(what) - 1)][1],
            "time": t.time[rows].tolist(),
            "sample_time": t.time[rows].tolist(),
            "measured": measured[rows, d].tolist(),
            **{stage: c[rows, d].tolist() for stage, c in curves.items()},
        }
        for d in range(min(measured.shape[1], _TRACES))
    ]
