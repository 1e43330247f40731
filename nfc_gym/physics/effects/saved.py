"""Effects with their values as plain rows, as `effects.yaml`, `fit.json` and a wrapper's arguments hold them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects import build
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.each import Each, each

Array = NDArray[np.float64]


def to_row(effect: Effect, theta: Array) -> dict[str, Any]:
    """An effect and its values (k,) as JSON-able data; `from_row` reads it back."""
    return {
        "family": effect.family,
        "where": list(effect.where),
        "each": isinstance(effect, Each),
        "parameters": {p.name: {"value": float(v), "unit": p.unit} for p, v in zip(effect.params, theta, strict=True)},
    }


def from_row(row: Mapping[str, Any]) -> tuple[Effect, Array]:
    """An effect and its values from a row: `family`, `where`, `parameters`, and `each` or `own_values` where it has
    some.

    Raises:
      InputError: a key is missing, or the family, a parameter or a value is none.
    """
    missing = [k for k in ("family", "where", "parameters") if k not in row]
    if missing:
        raise InputError(
            f"an effect needs the keys family, where, parameters; {missing[0]!r} is missing in {dict(row)}"
        )
    try:
        if not (row.get("each") or row.get("own_values")):
            return build(row["family"], row["where"], row["parameters"])
        members, thetas = [], []
        places = [row["where"]] if isinstance(row["where"], str) else row["where"]
        for place in places:
            own = {k.rpartition("@")[0]: v for k, v in row["parameters"].items() if k.rpartition("@")[2] == place}
            member, theta = build(row["family"], [place], own)
            members.append(member)
            thetas.append(theta)
    except (TypeError, KeyError, ValueError) as e:
        if isinstance(e, InputError):
            raise
        raise InputError(
            f"effect {row['family']!r} of {row['where']!r}: a parameter's value is no number ({e})"
        ) from None
    return each(members), np.concatenate(thetas)
