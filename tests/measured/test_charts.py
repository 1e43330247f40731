"""The report's charts: round ticks, curves to scale, gaps where values are missing."""

import re

import numpy as np
import pytest

from nfc_gym.measured.charts import Series, error_chart, nice_ticks, trace_chart


@pytest.mark.parametrize("high", [1e-9, 0.4, 1.0, 7.3, 1234.5])
def test_ticks_are_round_inside_and_few(high: float) -> None:
    low = -0.37 * high
    ticks = nice_ticks(low, high, 5)
    assert 2 <= len(ticks) <= 6
    assert all(low * (1 + 1e-9) <= t <= high * (1 + 1e-9) for t in ticks)
    np.testing.assert_allclose(np.diff(ticks), ticks[1] - ticks[0])


def heights(figure: str, cls: str) -> list[float]:
    path = re.search(rf'<path class="line {cls}" d="([^"]*)"', figure)
    assert path
    return [float(p.split()[1]) for p in re.split("[ML]", path[1])[1:]]


def test_a_curve_is_drawn_to_scale() -> None:
    figure = error_chart("g", "m", [Series("a", "nominal", [0, 1, 2], [0.0, 1.0, 2.0])])
    y = heights(figure, "nominal")
    assert y[0] - y[1] == pytest.approx(y[1] - y[0 + 2], abs=0.11)
    assert y[0] > y[2]
    far = Series("b", "calibrated", [1], [100.0])
    decades = heights(error_chart("g", "m", [Series("a", "nominal", [0, 1, 2], [0.01, 0.1, 1.0]), far]), "nominal")
    assert decades[0] - decades[1] == pytest.approx(decades[1] - decades[2], abs=0.11)


def test_a_gap_is_left_where_a_value_is_missing() -> None:
    figure = trace_chart("t", "m", [Series("a", "nominal", range(5), [0.0, 1.0, None, 1.0, 0.0])])
    path = re.search(r'<path class="line nominal" d="([^"]*)"', figure)
    assert path
    assert path[1].count("M") == 2


def test_a_prediction_that_runs_away_does_not_flatten_the_measurement() -> None:
    t = np.linspace(0, 1, 50)
    calm = Series("m", "measured", t.tolist(), np.sin(6 * t).tolist(), dots=True)
    wild = Series("c", "calibrated", t.tolist(), (1e6 * t).tolist())
    figure = trace_chart("t", "m", [wild, calm])
    path = re.search(r'<path class="dots measured" d="([^"]*)"', figure)
    assert path
    y = [float(p.split()[1].removesuffix("h0")) for p in path[1].split("M")[1:]]
    assert max(y) - min(y) > 50
