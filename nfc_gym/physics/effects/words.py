"""Numbers and names as a reader wants them: to the digits that are known, and with commas."""

import math
from collections.abc import Sequence

_SMALL, _LARGE, _PLACES = 1e-4, 1e6, 6  # between which numbers are written without a power of ten; decimals at most


def with_spread(value: float, sd: float | None = None) -> str:
    """`20.31 ± 0.34`: a value and the half width of its 95 % interval, to two digits of that; a bare value to three.

    Args:
      value: in any unit.
      sd: its standard deviation; None, NaN or infinite where it is not known.
    """
    if sd is None or not math.isfinite(sd) or sd <= 0:
        return f"{value:.3g}"
    half = float(f"{1.96 * sd:.1e}")
    places = 1 - math.floor(math.log10(half))
    if not _SMALL <= max(abs(value), half) < _LARGE or places > _PLACES:
        return f"{value:.3g} ± {half:.2g}"
    decimals = max(places, 0)
    return f"{round(value, places) + 0.0:.{decimals}f} ± {half:.{decimals}f}"


def together(names: Sequence[str]) -> str:
    """`a`, `a and b`, `a, b and c`."""
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
