"""The page beside proposed commands: what they are to tell, what they look like, and the motion that is expected."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.measured import charts, wording
from nfc_gym.measured.charts import Series
from nfc_gym.measured.experiment import Stage
from nfc_gym.measured.observe import Observer
from nfc_gym.measured.report import page
from nfc_gym.physics.segments import Trajectory

Array = NDArray[np.float64]
_POINTS = 500  # of a curve
_FIGURES = 24  # of each kind


def render(
    result: Mapping[str, Any], stage: Stage, shown: Mapping[str, tuple[str, Array]], motion: Trajectory | None
) -> str:
    """The page.

    Args:
      result: as in the JSON file.
      stage: where the commands were tried.
      shown: control -> its unit and values (T,).
      motion: expected of the commands by themselves; None for a feed-forward.
    """
    commands = [_figure(name, unit, stage.time, values) for name, (unit, values) in shown.items()]
    expected = [] if motion is None else _motions(stage, motion)
    return page(
        "excite.html.j2",
        result=result,
        pairs=result.get("pairs") or [],
        sizes=result.get("sizes") or [],
        commands=commands[:_FIGURES],
        expected=expected[:_FIGURES],
        left_out=max(len(commands) - _FIGURES, 0) + max(len(expected) - _FIGURES, 0),
    )


def _figure(title: str, unit: str, time: Array, values: Array) -> dict[str, Any]:
    every = max(1, len(time) // _POINTS)
    curve = Series(title, "extended", time[::every].tolist(), values[::every].tolist())
    return {"title": title, "figure": charts.trace_chart(title, wording.unit(unit), [curve])}


def _motions(stage: Stage, motion: Trajectory) -> list[dict[str, Any]]:
    """A figure for each component of each channel that the logs measure, sensors left out."""
    base = stage.bench.rollouts([stage.start], [stage.bench.states[stage.start.name]])
    out = []
    for o in base.observers:
        if o.needs_sensors:
            continue
        values = o.predict(motion)[0, 0]
        time: Array = np.arange(len(values), dtype=np.float64) * float(stage.plant.model.opt.timestep)
        out += [_figure(_title(o, i, values.shape[1]), o.unit, time, values[:, i]) for i in range(values.shape[1])]
    return out


def _title(o: Observer, i: int, count: int) -> str:
    names = "wxyz" if o.quaternion else "xyz"
    return o.name if count == 1 else f"{o.name} {names[i]}"
