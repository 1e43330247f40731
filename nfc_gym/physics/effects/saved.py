"""Effects with their values as plain rows, as `effects.yaml`, `fit.json` and a wrapper's arguments hold them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects import build, number
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.conditions import Conditioned
from nfc_gym.physics.effects.each import Each, each

Array = NDArray[np.float64]
_READ = ("family", "where", "parameters", "each", "own_values", "conditions", "settings")
# What the measured loop says of an effect besides, in `effects.yaml` and `report.json`.
_TOLD = ("id", "sentence", "share_of_excess", "equivalents", "proposal", "nearest", "alike", "mended_by")


def to_row(effect: Effect, theta: Array) -> dict[str, Any]:
    """An effect and its values (k,) as JSON-able data; `from_row` reads it back."""
    conditions = {"conditions": list(effect.conditions)} if isinstance(effect, Conditioned) else {}
    return {
        "family": effect.family,
        "where": list(effect.where),
        "each": isinstance(effect, Each),
        **conditions,
        **({"settings": effect.settings} if effect.settings else {}),
        "parameters": {p.name: {"value": float(v), "unit": p.unit} for p, v in zip(effect.params, theta, strict=True)},
    }


def from_row(row: Mapping[str, Any]) -> tuple[Effect, Array]:
    """An effect and its values from a row: `family`, `where`, `parameters`, and `each` or `own_values`, `conditions`
    and `settings` where it has some.

    Raises:
      InputError: a key is missing or unknown, or the family, a parameter or a value is none, or cannot be.
    """
    family, where, parameters = _keys(row)
    try:
        if row.get("conditions"):
            return _conditioned(family, where, parameters, row)
        if not (row.get("each") or row.get("own_values")):
            return _possible(*_built(family, where, parameters, row))
        members, thetas = [], []
        for place in [where] if isinstance(where, str) else where:
            own = {name: v for name, at, v in _apart(parameters) if at == place}
            member, theta = _possible(*_built(family, [place], own, row))
            members.append(member)
            thetas.append(theta)
    except (TypeError, KeyError, ValueError, OverflowError) as e:
        if isinstance(e, InputError):
            raise
        raise InputError(
            f"effect {family!r} of {where!r}: a parameter is a number, or a mapping with a number as `value`, and not "
            f"as it is here ({e})"
        ) from None
    return each(members), np.concatenate(thetas)


def _built(family: str, where: str | list[str], parameters: Mapping, row: Mapping) -> tuple[Effect, Array]:
    """`build`, with the settings of a row."""
    effect, theta = build(family, where, parameters)
    settings = row.get("settings", {})
    if not isinstance(settings, Mapping) or not set(settings) <= set(effect.SETTINGS):
        known = ", ".join(effect.SETTINGS) or "none"
        raise InputError(f"effect {family!r}: `settings` maps names to values, of: {known}; and not {_short(settings)}")
    for name, value in settings.items():
        wanted = type(getattr(effect, name))
        if type(value) is not wanted:
            raise InputError(f"effect {family!r}: {name} is {_short(value)}; want a value of type {wanted.__name__}")
        setattr(effect, name, value)
    return effect, theta


def _conditioned(family: str, where: str | list[str], given: Mapping[str, Any], row: Mapping) -> tuple[Effect, Array]:
    """An effect with values of its own in each condition."""
    labels = row["conditions"]
    if not isinstance(labels, list | tuple) or not labels:
        raise InputError(f"effect {family!r}: `conditions` is a list of labels, and not {_short(labels)}")
    labels = [str(c) for c in labels]
    first = {name: v for name, at, v in _apart(given) if at in ("", labels[0])}
    effect = Conditioned(_built(family, where, first, row)[0], labels)
    missing = [p.name for p in effect.params if p.name not in given]
    if missing:
        raise InputError(f"{effect.id}: the value of {missing[0]!r} is missing; there are: {', '.join(given)}")
    values = [(f"{family}: {p.name}", given[p.name]) for p in effect.params]
    values = [number(v["value"] if isinstance(v, Mapping) else v, what) for what, v in values]
    return _possible(effect, np.array(values))


def _apart(parameters: Mapping[str, Any]) -> list[tuple[str, str, Any]]:
    """Name, place or condition, and value of each `name@place`; places may hold an @ (`body:b:linvel@body`)."""
    parts = [(*k.partition("@"), v) for k, v in parameters.items()]
    return [(name, at, v) for name, _, at, v in parts]


def _keys(row: Any) -> tuple[str, str | list[str], Mapping[str, Any]]:
    """Family, places and parameters of a row; what is missing, unknown, or of another kind than they are, raises."""
    if not isinstance(row, Mapping):
        raise InputError(f"an effect is a mapping with the keys family, where, parameters, and not {_short(row)}")
    for key in ("family", "where", "parameters"):
        if key not in row:
            raise InputError(
                f"an effect needs the keys family, where, parameters; {key!r} is missing in {_short(dict(row))}"
            )
    unknown = [key for key in row if key not in (*_READ, *_TOLD)]
    if unknown:
        raise InputError(f"an effect has the keys {', '.join(_READ)}; {unknown[0]!r} is none, in {_short(dict(row))}")
    family, where, parameters = row["family"], row["where"], row["parameters"]
    if not isinstance(family, str):
        raise InputError(f"an effect's family is a name, and not {_short(family)}")
    names = [where] if isinstance(where, str) else where
    if not isinstance(names, list | tuple) or not names or not all(isinstance(n, str) and n for n in names):
        raise InputError(
            f"effect {family!r}: `where` is a name of the model, a list of names, or `all`, and not {_short(where)}"
        )
    if not isinstance(parameters, Mapping) or not all(isinstance(k, str) for k in parameters):
        raise InputError(
            f"effect {family!r}: `parameters` is a mapping of names to values, and not {_short(parameters)}"
        )
    return family, where if isinstance(where, str) else list(names), parameters


def _possible(effect: Effect, theta: Array) -> tuple[Effect, Array]:
    effect.require_possible(theta)
    return effect, theta


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
