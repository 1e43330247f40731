"""An effect some of whose parameters belong to the day: one drag coefficient, and the wind of each of four flights.

`Conditioned` holds the shared parameters once and the others once for each condition of the logs. It acts through the
effect inside it, which `Plant.under` puts in its place with the values of each segment's condition.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Array, Effect

MARK = ":conditions"


class Conditioned(Effect):
    """An effect with values of its own in each condition; those are named `<parameter>@<condition>`.

    Args:
      inner: the effect; what its parameters mark as `ambient` differs between conditions, the rest is shared.
      conditions: labels, two or more.

    Raises:
      InputError: the effect has no ambient parameter, or there are fewer than two conditions.
    """

    def __init__(self, inner: Effect, conditions: Sequence[str]) -> None:
        own = [i for i, p in enumerate(inner.params) if p.ambient]
        if not own:
            raise InputError(f"{inner.id} has no parameter that may differ between conditions")
        if len(set(conditions)) < 2:
            raise InputError(f"{inner.id}: values for each condition need two conditions, got: {', '.join(conditions)}")
        shared = [i for i, p in enumerate(inner.params) if not p.ambient]
        self.inner, self.conditions = inner, tuple(conditions)
        for name in ("family", "summary", "generic", "simpler", "covers"):
            setattr(self, name, getattr(inner, name))
        params = [inner.params[i] for i in shared]
        params += [replace(inner.params[i], name=f"{inner.params[i].name}@{c}") for c in conditions for i in own]
        super().__init__(inner.where, params)
        # Which of these parameters each of the inner effect's is, in every condition.
        self.columns = np.empty((len(self.conditions), len(inner.params)), np.intp)
        self.columns[:, shared] = np.arange(len(shared))
        self.columns[:, own] = len(shared) + np.arange(len(self.conditions) * len(own)).reshape(-1, len(own))

    @property
    def id(self) -> str:
        """`family:place`, with a mark that values differ."""
        return self.inner.id + MARK

    @property
    def signals(self) -> tuple[str, ...]:
        """Exogenous signals that the effect reads."""
        return self.inner.signals

    @property
    def settings(self) -> dict[str, Any]:
        """Those of the effect inside."""
        return self.inner.settings

    def bind(self, model: mujoco.MjModel) -> None:
        """See `Effect`."""
        self.inner.bind(model)

    def index(self, labels: Sequence[str] | NDArray[np.str_]) -> NDArray[np.intp]:
        """Labels -> which condition each is; one that was never fitted raises `InputError`."""
        unknown = sorted({str(c) for c in labels} - set(self.conditions))
        if unknown:
            known = ", ".join(self.conditions)
            raise InputError(f"{self.id} has no values for the condition {unknown[0]!r}; it was fitted in: {known}")
        return np.array([self.conditions.index(str(c)) for c in labels], np.intp)

    def inside(self, theta: Array, label: str) -> Array:
        """The inner effect's parameters (..., k') in a condition; theta (..., k)."""
        return theta[..., self.columns[int(self.index([label])[0])]]

    def say(self, theta: Array, sd: Array | None = None) -> str:
        """One sentence for each condition."""
        parts = []
        for label in self.conditions:
            spread = None if sd is None else self.inside(sd, label)
            parts.append(f"In {label}: {self.inner.say(self.inside(theta, label), spread)}")
        return " ".join(parts)


def conditioned(effects: Sequence[Effect], conditions: Sequence[str]) -> list[Conditioned]:
    """Those effects that may differ between conditions, with values of their own in each."""
    able = [e for e in effects if not e.generic and any(p.ambient for p in e.params)]
    return [Conditioned(e, conditions) for e in able] if len(conditions) > 1 else []
