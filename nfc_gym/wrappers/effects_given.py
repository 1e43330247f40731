"""Effects as `ApplyEffects` is given them: pairs, rows of plain data, or a file; what cannot be is refused."""

import copy
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.physics.effects.base import Effect
from nfc_gym.physics.effects.conditions import Conditioned
from nfc_gym.physics.effects.saved import from_row, to_row
from nfc_gym.physics.parameters import numbers
from nfc_gym.wrappers.effects_file import read_effects

Array = NDArray[np.float64]
Given = Sequence[tuple[Effect, Array] | Mapping[str, Any]] | str | os.PathLike[str]


def recorded(effects: Given) -> list[dict[str, Any]] | str:
    """Effects as a spec keeps them: rows of plain data, or a path."""
    if isinstance(effects, str | os.PathLike):
        return os.fspath(effects)
    if not isinstance(effects, Iterable):  # which `bound` refuses
        return effects
    return [_recorded(e) for e in effects]


def _recorded(given: Any) -> Any:
    """One of them; what is neither a pair nor a row is left to `bound` to refuse."""
    if _is_pair(given):
        return to_row(given[0], _values(*given))
    return dict(given) if isinstance(given, Mapping) else given


def _is_pair(given: Any) -> bool:
    return isinstance(given, tuple) and len(given) == 2 and isinstance(given[0], Effect)


def _own_pair(given: Any) -> tuple[Effect, Array]:
    """An effect that nobody else holds, and its values."""
    return copy.deepcopy(given) if _is_pair(given) else from_row(given)


def _values(effect: Effect, theta: ArrayLike) -> Array:
    """Values (k,) of an effect; another number of them, or what cannot be, raises `InputError`."""
    try:
        values = numbers(theta, effect.id)
    except InputError:
        values = np.zeros(0)
    if values.shape != (len(effect.params),) or not np.isfinite(values).all():
        names = ", ".join(p.name for p in effect.params)
        raise InputError(f"ApplyEffects: {effect.id} takes finite values of {names}, got {theta}")
    effect.require_possible(values)
    return values


def bound(effects: Given, model: mujoco.MjModel, condition: str | None = None) -> tuple[list[Effect], list[Array]]:
    """Effects of their own, bound to a model, and their values in a condition.

    Raises:
      InputError: a row, a family, a place or a parameter that does not exist, values of another number, or values that
        cannot be (`Param.nature`).
    """
    if isinstance(effects, str | os.PathLike):
        try:
            return bound(read_effects(effects)["effects"], model, condition)
        except InputError as e:
            file = os.fspath(effects)
            raise InputError(str(e) if str(e).startswith(file) else f"{file}: {e}") from None
    if isinstance(effects, Mapping) or not isinstance(effects, Iterable):
        raise InputError(f"ApplyEffects: effects is {effects!r}; want a list of them, or the path of an effects.yaml")
    pairs = [_own_pair(e) for e in effects]
    pairs = [_in_condition(effect, _values(effect, theta), condition) for effect, theta in pairs]
    for effect, _ in pairs:
        effect.bind(model)
    return [e for e, _ in pairs], [t for _, t in pairs]


def _in_condition(effect: Effect, theta: Array, condition: str | None) -> tuple[Effect, Array]:
    """The effect with its values of one condition, where they differ."""
    if not isinstance(effect, Conditioned):
        return effect, theta
    if condition is None:
        known = ", ".join(effect.conditions)
        raise InputError(f"ApplyEffects: {effect.id} differs between conditions: say condition=, one of {known}")
    return effect.inner, effect.inside(theta, condition)


def own_values(effects: Sequence[Effect], each: Sequence[ArrayLike], shape: tuple[int, ...]) -> list[Array]:
    """Values (*shape, k) of each effect.

    Raises:
      InputError: of another number or shape, not finite, or what cannot be.
    """
    if len(each) != len(effects):
        raise InputError(f"ApplyEffects: values of {len(each)} effects are given, and there are {len(effects)}")
    found = [np.array(numbers(v, f"ApplyEffects: values of {e.id}")) for v, e in zip(each, effects, strict=True)]
    for effect, theta in zip(effects, found, strict=True):
        want = (*shape, len(effect.params))
        if theta.shape != want or not np.isfinite(theta).all():
            raise InputError(f"ApplyEffects: values of {effect.id} must be finite, of shape {want}, got {theta.shape}")
        over = tuple(range(len(shape)))
        for extreme in (theta.min(over), theta.max(over)):
            effect.require_possible(extreme)
    return found
