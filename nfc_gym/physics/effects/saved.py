"""Effects with their values as plain rows, as `effects.yaml`, `fit.json` and a wrapper's arguments hold them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects import build
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.conditions import Conditioned
from nfc_gym.physics.effects.each import Each, each

Array = NDArray[np.float64]


def to_row(effect: Effect, theta: Array) -> dict[str, Any]:
    """An effect and its values (k,) as JSON-able data; `from_row` reads it back."""
    conditions = {"conditions": list(effect.conditions)} if isinstance(effect, Conditioned) else {}
    return {
        "family": effect.family,
        "where": list(effect.where),
        "each": isinstance(effect, Each),
        **conditions,
        "parameters": {p.name: {"value": float(v), "unit": p.unit} for p, v in zip(effect.params, theta, strict=True)},
    }


def from_row(row: Mapping[str, Any]) -> tuple[Effect, Array]:
    """An effect and its values from a row: `family`, `where`, `parameters`, and `each` or `own_values` or
    `conditions` where it has some.

    Raises:
      InputError: a key is missing, or the family, a parameter or a value is none.
    """
    missing = [k for k in ("family", "where", "parameters") if k not in row]
    if missing:
        raise InputError(
            f"an effect needs the keys family, where, parameters; {missing[0]!r} is missing in {dict(row)}"
        )
    try:
        if row.get("conditions"):
            return _conditioned(row)
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


def _conditioned(row: Mapping[str, Any]) -> tuple[Effect, Array]:
    """An effect with values of its own in each condition."""
    labels, given = [str(c) for c in row["conditions"]], row["parameters"]
    first = {k.rpartition("@")[0] or k: v for k, v in given.items() if "@" not in k or k.endswith(f"@{labels[0]}")}
    effect = Conditioned(build(row["family"], row["where"], first)[0], labels)
    missing = [p.name for p in effect.params if p.name not in given]
    if missing:
        raise InputError(f"{effect.id}: the value of {missing[0]!r} is missing; there are: {', '.join(given)}")
    values = [given[p.name] for p in effect.params]
    return effect, np.array([float(v["value"] if isinstance(v, Mapping) else v) for v in values])
