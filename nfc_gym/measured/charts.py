"""Line charts, bars and heat strips as inline SVG: no script, they follow the page's colours and print as they look.

Everything here returns `Markup`; names and units are escaped. Colours are the classes of `templates/page.css`.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from nfc_gym.measured.wording import finite, fixed, number, plain, quantity

_WIDTH, _HEIGHT = 440, 230
_LEFT, _RIGHT, _TOP, _BOTTOM = 72, 10, 12, 40
_RANGE_OF_LOG = 15.0  # worst over best model from which a logarithmic axis shows more than a linear one
_FAR = 1.5  # how many measured ranges beyond the measurement a prediction is still drawn
_FEW = 30  # samples up to which they are drawn large, and say little of the range


@dataclass(frozen=True)
class Series:
    """One curve: `cls` is its colour class, `dots` draws samples instead of a line; None or NaN leaves a gap."""

    name: str
    cls: str
    x: Sequence[Any]
    y: Sequence[Any]
    dots: bool = False

    def points(self) -> list[tuple[float | None, float | None]]:
        """Pairs, with None for what cannot be drawn."""
        return [(finite(a), finite(b)) for a, b in zip(self.x, self.y, strict=False)]


@dataclass(frozen=True)
class _Axis:
    """Maps values from low..high to pixels start..end."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def __call__(self, value: float) -> float:
        if self.log:
            value, low, high = (math.log10(max(v, 1e-300)) for v in (value, self.low, self.high))
        else:
            low, high = self.low, self.high
        return self.start + (value - low) / (high - low) * (self.end - self.start)

    def ticks(self, most: int) -> list[float]:
        """Round values inside the range."""
        if not self.log:
            return nice_ticks(self.low, self.high, most)
        first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
        for steps in ((1, 2, 5), (1, 3), (1,)):
            found = [s * 10.0**k for k in range(first, last + 1) for s in steps]
            inside = [v for v in found if self.low * 0.999 <= v <= self.high * 1.001]
            if len(inside) <= most + 1:
                return inside
        return inside[:: max(1, math.ceil(len(inside) / most))]


def nice_ticks(low: float, high: float, most: int = 5) -> list[float]:
    """At most so many + 1 multiples of 1, 2 or 5 times a power of ten between low and high."""
    if not high > low:
        return [low]
    raw = (high - low) / most
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= raw * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def _text(x: float, y: float, words: str, anchor: str = "middle", more: str = "") -> Markup:
    return Markup('<text x="{}" y="{}" text-anchor="{}"{}>{}</text>').format(
        f"{x:.1f}", f"{y:.1f}", anchor, Markup(more), words
    )


def _frame(x: _Axis, y: _Axis, x_label: str, y_label: str) -> Markup:
    """Grid lines, tick labels and axis titles."""
    parts = []
    ticks = y.ticks(5)
    for v, label in zip(ticks, _labels(y, ticks), strict=True):
        at = y(v)
        parts.append(Markup('<path class="grid" d="M{} {}H{}"/>').format(_LEFT, f"{at:.1f}", _WIDTH - _RIGHT))
        parts.append(_text(_LEFT - 6, at + 4, label, "end"))
    for v in x.ticks(6):
        parts.append(Markup('<path class="grid" d="M{} {}v4"/>').format(f"{x(v):.1f}", _HEIGHT - _BOTTOM))
        parts.append(_text(x(v), _HEIGHT - _BOTTOM + 17, plain(v)))
    parts.append(Markup('<path class="axis" d="M{} {}H{}"/>').format(_LEFT, _HEIGHT - _BOTTOM, _WIDTH - _RIGHT))
    parts.append(_text((_LEFT + _WIDTH - _RIGHT) / 2, _HEIGHT - 5, x_label))
    middle = (_TOP + _HEIGHT - _BOTTOM) / 2
    parts.append(_text(13, middle, y_label, more=f' transform="rotate(-90 13 {middle:.1f})"'))
    return Markup("").join(parts)


def _labels(axis: _Axis, ticks: Sequence[float]) -> list[str]:
    """Ticks as text, all with the same number of places."""
    step = ticks[1] - ticks[0] if len(ticks) > 1 else 0.0
    largest = max((abs(t) for t in ticks), default=0.0)
    if axis.log or not 1e-4 <= step <= largest < 1e5:
        return [number(t, 1 if axis.log else 3) for t in ticks]
    return ["0" if abs(t) < 1e-9 * step else fixed(t, max(0, -math.floor(math.log10(step) + 1e-9))) for t in ticks]


def _path(series: Series, x: _Axis, y: _Axis) -> Markup:
    """The curve's path element; gaps where a value is missing, a dot where a value stands alone."""
    steps, pen_up = [], True
    points = series.points()
    for i, (a, b) in enumerate(points):
        if a is None or b is None or (y.log and b <= 0):
            pen_up = True
            continue
        at = f"{x(a):.1f} {max(-999.0, min(y(b), 9999.0)):.1f}"
        alone = pen_up and (i + 1 == len(points) or points[i + 1][1] is None)
        steps.append(f"M{at}h0" if series.dots or alone else f"{'M' if pen_up else 'L'}{at}")
        pen_up = series.dots
    kind = "line" if not series.dots else "dots" if len(points) > _FEW else "dots few"
    return Markup('<path class="{} {}" d="{}"><title>{}</title></path>').format(
        kind, series.cls, "".join(steps), series.name
    )


def _markers(series: Series, x: _Axis, y: _Axis) -> Markup:
    """Dots at the points of a curve that has few, each with its value as a tooltip."""
    out = []
    for a, b in series.points():
        if a is not None and b is not None and not (y.log and b <= 0):
            out.append(
                Markup('<circle class="{}" cx="{}" cy="{}" r="3"><title>{}: {} at {}</title></circle>').format(
                    series.cls, f"{x(a):.1f}", f"{y(b):.1f}", series.name, number(b), plain(a)
                )
            )
    return Markup("").join(out)


def _svg(width: float, height: float, label: str, body: Iterable[Markup]) -> Markup:
    return Markup('<svg class="chart" viewBox="0 0 {} {}" role="img" aria-label="{}">{}</svg>').format(
        f"{width:g}", f"{height:g}", label, Markup("").join(body)
    )


def _inner(curves: Iterable[Markup]) -> Markup:
    """Curves cut off at the plot's frame."""
    box = (_LEFT, _TOP, _WIDTH - _RIGHT, _HEIGHT - _BOTTOM)
    size = (box[2] - box[0], box[3] - box[1])
    return Markup('<svg x="{0}" y="{1}" width="{2}" height="{3}" viewBox="{0} {1} {2} {3}">{4}</svg>').format(
        box[0], box[1], *size, Markup("").join(curves)
    )


def _apart(series: Sequence[Series]) -> float:
    """Largest ratio of two curves at one place."""
    columns: dict[float, list[float]] = {}
    for a, b in (point for s in series for point in s.points()):
        if a is not None and b is not None and b > 0:
            columns.setdefault(a, []).append(b)
    return max((max(c) / min(c) for c in columns.values()), default=1.0)


def error_chart(label: str, unit: str, series: Sequence[Series]) -> Markup:
    """Error against horizon, from zero; logarithmic where the curves lie far apart."""
    xs = [a for s in series for a, _ in s.points() if a is not None]
    ys = [b for s in series for _, b in s.points() if b is not None and b >= 0]
    positive = [b for b in ys if b > 0]
    if not xs or not positive:
        return Markup('<p class="none">No value to draw.</p>')
    log = _apart(series) > _RANGE_OF_LOG
    x = _Axis(0.0, max(xs) * 1.02 or 1.0, _LEFT, _WIDTH - _RIGHT)
    low = min(positive) / 1.3 if log else 0.0
    y = _Axis(low, max(positive) * (1.3 if log else 1.08), _HEIGHT - _BOTTOM, _TOP, log)
    title = f"error{f' ({unit})' if unit else ''}{', log scale' if log else ''}"
    body = [_frame(x, y, "prediction horizon (s)", title)]
    body += [Markup("").join((_path(s, x, y), _markers(s, x, y))) for s in series]
    return _svg(_WIDTH, _HEIGHT, f"{label}: error against horizon", body)


def misfit_chart(label: str, unit: str, series: Sequence[Series]) -> Markup:
    """Misfit in noise widths over a coordinate of the state."""
    xs = [a for s in series for a, _ in s.points() if a is not None]
    ys = [b for s in series for _, b in s.points() if b is not None]
    if not xs or not ys or max(ys) <= 0:
        return Markup('<p class="none">No value to draw.</p>')
    x = _Axis(min(xs), max(xs) if max(xs) > min(xs) else min(xs) + 1.0, _LEFT, _WIDTH - _RIGHT)
    y = _Axis(0.0, 1.08 * max(ys), _HEIGHT - _BOTTOM, _TOP)
    body = [_frame(x, y, unit, "misfit, × noise")]
    body += [Markup("").join((_path(s, x, y), _markers(s, x, y))) for s in series]
    return _svg(_WIDTH, _HEIGHT, label, body)


def heat_grid(label: str, x: Sequence[float], y: Sequence[float], rows: Sequence[Sequence[Any]], top: float) -> Markup:
    """Misfit over two coordinates: cells between the edges x and y (m), darker from 1 to top on a log scale.

    `rows` hold mean square misfits, a row for each stretch of y from below; None leaves a cell bare.
    """
    ends = [finite(v) for v in (x[0], x[-1], y[0], y[-1])]
    if None in ends or not (x[-1] > x[0] and y[-1] > y[0]):
        return Markup('<p class="none">No value to draw.</p>')
    across = _Axis(x[0], x[-1], _LEFT, _WIDTH - _RIGHT)
    up = _Axis(y[0], y[-1], _HEIGHT - _BOTTOM, _TOP)
    body = [_frame(across, up, "x (m)", "y (m)")]
    for j, row in enumerate(rows):
        for i, value in enumerate(row):
            v = finite(value)
            if v is None:
                continue
            shade = 0.0 if v <= 1 or top <= 1 else min(math.log(v) / math.log(top), 1.0)
            cell = Markup(
                '<rect class="heat" x="{}" y="{}" width="{}" height="{}" fill-opacity="{}"><title>{}</title></rect>'
            )
            body.append(
                cell.format(
                    f"{across(x[i]):.1f}",
                    f"{up(y[j + 1]):.1f}",
                    f"{across(x[i + 1]) - across(x[i]):.1f}",
                    f"{up(y[j]) - up(y[j + 1]):.1f}",
                    f"{0.06 + 0.94 * shade:.2f}",
                    f"{number(math.sqrt(max(v, 0.0)))} × noise",
                )
            )
    return _svg(_WIDTH, _HEIGHT, label, body)


def curve_chart(label: str, x_label: str, y_label: str, series: Sequence[Series]) -> Markup:
    """Values against anything, on axes that just hold them."""
    points = [(a, b) for s in series for a, b in s.points() if a is not None and b is not None]
    if not points:
        return Markup('<p class="none">No value to draw.</p>')
    xs, ys = zip(*points, strict=True)
    margin = 0.06 * (max(ys) - min(ys)) or max(abs(max(ys)), 1.0) * 0.1
    x = _Axis(min(xs), max(xs) if max(xs) > min(xs) else min(xs) + 1.0, _LEFT, _WIDTH - _RIGHT)
    y = _Axis(min(ys) - margin, max(ys) + margin, _HEIGHT - _BOTTOM, _TOP)
    body = [_frame(x, y, x_label, y_label), *(_path(s, x, y) for s in series)]
    return _svg(_WIDTH, _HEIGHT, label, body)


def trace_chart(label: str, unit: str, series: Sequence[Series]) -> Markup:
    """Values against time; the range is the measurement's, so that a prediction that runs away does not flatten it."""
    xs = [a for s in series for a, b in s.points() if a is not None and b is not None]
    lead = [b for s in series if s.dots for _, b in s.points() if b is not None]
    rest = [b for s in series for _, b in s.points() if b is not None]
    if not xs or not rest:
        return Markup('<p class="none">No value to draw.</p>')
    lead = lead or rest
    reach = (_FAR if len(lead) > _FEW else 4 * _FAR) * ((max(lead) - min(lead)) or max(abs(max(lead)), 1e-9))
    low, high = max(min(rest), min(lead) - reach), min(max(rest), max(lead) + reach)
    margin = 0.06 * (high - low) or max(abs(high), 1.0) * 0.1
    x = _Axis(min(xs), max(xs) if max(xs) > min(xs) else min(xs) + 1.0, _LEFT, _WIDTH - _RIGHT)
    y = _Axis(low - margin, high + margin, _HEIGHT - _BOTTOM, _TOP)
    body = [_frame(x, y, "time (s)", unit), _inner(_path(s, x, y) for s in series)]
    return _svg(_WIDTH, _HEIGHT, label, body)


def bar_chart(label: str, unit: str, bars: Sequence[tuple[str, str, Any]], floor: Any) -> Markup:
    """Horizontal bars (name, class, value) from zero, with their values, and the noise floor as a dashed line."""
    values = [finite(v) for *_, v in bars]
    mark = finite(floor)
    top = max([v for v in (*values, mark) if v is not None], default=0.0)
    if top <= 0:
        return Markup('<p class="none">No value to draw.</p>')
    left, right, step = 100, 95, 30
    height = step * len(bars) + (24 if mark is not None else 8)
    scale = (_WIDTH - left - right) / top
    body = []
    for i, ((name, cls, _), v) in enumerate(zip(bars, values, strict=True)):
        at = 4 + i * step
        body.append(_text(left - 8, at + 16, name, "end"))
        width = 0.0 if v is None else max(v * scale, 1.0)
        bar = Markup('<rect class="{}" x="{}" y="{}" width="{}" height="20"/>')
        body.append(bar.format(cls, left, at, f"{width:.1f}"))
        beyond = width if mark is None else max(width, mark * scale if abs(mark * scale - width) < right else width)
        body.append(_text(left + beyond + 6, at + 15, quantity(v, unit), "start"))
    if mark is not None:
        at = left + mark * scale
        body.append(Markup('<path class="line floor" d="M{} 2V{}"/>').format(f"{at:.1f}", height - 20))
        anchor = "start" if at < _WIDTH / 2 else "end"
        body.append(_text(at, height - 5, f"noise floor {quantity(mark, unit)}", anchor))
    return _svg(_WIDTH, height, f"{label}: error before and after", body)


def meter(value: Any, top: float, cls: str) -> Markup:
    """A bar for a table cell: value on a scale from 0 to top, as an image that prints."""
    x = finite(value)
    width = 0.0 if x is None or top <= 0 else 100 * min(max(x / top, 0.0), 1.0)
    return Markup(
        '<svg class="meter" viewBox="0 0 100 10" preserveAspectRatio="none" aria-hidden="true">'
        '<rect class="track" width="100" height="10"/><rect class="{}" width="{}" height="10"/></svg>'
    ).format(cls, f"{width:.1f}")


def heat_strip(label: str, cells: Sequence[tuple[float, float, Any, str]], end: float, top: float) -> Markup:
    """One log's misfit through time: cells (start s, end s, value, tooltip), darker from 1 to top on a log scale."""
    width = 400.0
    body = [Markup('<rect class="track" width="{}" height="14"/>').format(f"{width:g}")]
    for start, stop, value, tip in cells:
        v = finite(value)
        shade = 0.0 if v is None or v <= 1 or top <= 1 else min(math.log(v) / math.log(top), 1.0)
        body.append(
            Markup(
                '<rect class="heat" x="{}" width="{}" height="14" fill-opacity="{}"><title>{}</title></rect>'
            ).format(
                f"{start / end * width:.1f}",
                f"{max((stop - start) / end * width, 1.0):.1f}",
                f"{0.06 + 0.94 * shade:.2f}",
                tip,
            )
        )
    return Markup(
        '<svg class="strip" viewBox="0 0 {} 14" preserveAspectRatio="none" role="img" aria-label="{}">{}</svg>'
    ).format(f"{width:g}", label, Markup("").join(body))
