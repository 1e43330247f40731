"""Damage to what a run leaves behind: `fit.json` and `effects.yaml`, as data and as text."""

import copy
import json
from collections.abc import Callable
from random import Random
from typing import Any

import yaml

from damage.mappings import places
from damage.values import BYTES, odd

ROW = {
    "family": "coulomb",
    "where": ["hinge"],
    "each": False,
    "parameters": {"level": {"value": 0.1, "unit": "N m"}},
}
SLOW = {"family": "delay", "where": ["servo"], "parameters": {"delay": {"value": 0.03, "unit": "s"}}}
PSI = {"mass": 0.12, "damping": 0.2}
FIT = {
    "fold": "",
    "nominal": {"psi": {}, "effects": []},
    "calibrated": {"psi": PSI, "effects": []},
    "extended": {"psi": PSI, "effects": [ROW]},
}
EFFECTS = {"version": 1, "model_sha256": "", "effects": [ROW, SLOW], "carried_by_model": []}

Damaged = bytes
Kind = Callable[[dict[str, Any], Callable[[Any], str], Random], Damaged]


def _spot(data: Any, rng: Random) -> tuple[Any, Any]:
    place = rng.choice(list(places(data)))
    for step in place[:-1]:
        data = data[step]
    return data, place[-1]


def value(data: dict[str, Any], dump: Callable[[Any], str], rng: Random) -> Damaged:
    for _ in range(rng.randint(1, 3)):
        parent, key = _spot(data, rng)
        parent[key] = odd(rng)
    return dump(data).encode()


def missing(data: dict[str, Any], dump: Callable[[Any], str], rng: Random) -> Damaged:
    parent, key = _spot(data, rng)
    del parent[key]
    return dump(data).encode()


def names(data: dict[str, Any], dump: Callable[[Any], str], rng: Random) -> Damaged:
    """Other families, places and parameters."""
    text = dump(data)
    old = rng.choice(("coulomb", "hinge", "level", "mass", "value", "psi", "effects", "delay", "servo", "time"))
    new = rng.choice(
        (
            "",
            "x",
            "gain",
            "spring_offset",
            "payload",
            "generic_time",
            "wind",
            "slip",
            "bob",
            "world",
            "hinge+root",
            "ü",
            "0",
        )
    )
    return text.replace(old, new).encode()


def contents(data: dict[str, Any], dump: Callable[[Any], str], rng: Random) -> Damaged:
    return BYTES[rng.choice(list(BYTES))](dump(data).encode(), rng)


_DAMAGE: tuple[Kind, ...] = (value, missing, names, contents)


def _of(what: dict[str, Any], dump: Callable[[Any], str], damage: Kind) -> Callable[[Random], Damaged]:
    return lambda rng: damage(copy.deepcopy(what), dump, rng)


FITS: dict[str, Callable[[Random], Damaged]] = {f"fit.json: {d.__name__}": _of(FIT, json.dumps, d) for d in _DAMAGE} | {
    f"effects.yaml: {d.__name__}": _of(EFFECTS, yaml.safe_dump, d) for d in _DAMAGE
}
