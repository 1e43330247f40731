"""`Param`: one number of an effect, with its unit and what it can be."""

from dataclasses import dataclass

import numpy as np

_HAIR = 1e-9  # by which a fit's arithmetic may pass a bound that it stopped at
_NO_CHOICE = 0.01  # of a value: a range so narrow is no range


@dataclass(frozen=True)
class Param:
    """One parameter of an effect.

    Attributes:
      name, unit: as reports and `effects.yaml` have them.
      low, high: bounds of any fit.
      null: the value at which the effect vanishes.
      probes: realistic sizes to try first, in the parameter's own unit.
      shape: True where the parameter only shapes the effect (a Stribeck speed) and no value of it is null.
      resolution: a size below which nobody would speak of the effect.
      natural: True where the bounds are nature's own (a share of one), and not merely beyond all that is plausible: a
        fit may then rightly end there.
      floor: what any value lies above, fitted or given, where `low` does not say (see `nature`).
      ambient: True where the value belongs to the day and not to the machine (the wind, not the drag): it may differ
        from one condition of the logs to another.
    """

    name: str
    unit: str
    low: float
    high: float
    null: float = 0.0
    probes: tuple[float, ...] = ()
    shape: bool = False
    resolution: float = 0.0
    natural: bool = False
    ambient: bool = False
    floor: float | None = None

    @property
    def given(self) -> bool:
        """Whether its bounds leave no choice: it sets a unit, and nothing is measured of it."""
        return self.high - self.low < _NO_CHOICE * abs(self.high)

    @property
    def nature(self) -> tuple[float, float]:
        """(least, most) that a value can be at all, where the bounds of a fit only say what is plausible.

        The least is `floor`; without one it is 0, or nothing where `low` is negative. A share of one (`natural`) is 1
        at most. A least that the fit's bounds keep clear of is itself none.
        """
        least = self.floor if self.floor is not None else 0.0 if self.low >= 0 else -np.inf
        return least, 1.0 if self.natural else np.inf

    def possible(self, value: float) -> bool:
        """Whether there can be such a value at all."""
        least, most = self.nature
        return (value > least or self.low == least <= value + _HAIR) and value <= most + _HAIR

    @property
    def wanted(self) -> str:
        """What a value can be, for messages."""
        least, most = self.nature
        parts = [f"{least:g} or more" if self.low == least else f"more than {least:g}"] if least > -np.inf else []
        parts += [f"at most {most:g}"] if most < np.inf else []
        return " and ".join(parts)

    @property
    def bounds(self) -> str:
        """Name, bounds of a fit and unit, for messages."""
        return f"{self.name} ({self.low:g} to {self.high:g}{'' if self.unit == '1' else f' {self.unit}'})"
