"""Options and infos of a vector environment: for all, for each, for some."""

import operator
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.envs.contract import checked_options
from nfc_gym.physics.parameters import numbers

Ids = NDArray[np.intp]
# What can be gone through, but not as seeds; an iterator would be used up by the first wrapper that reads it.
_NO_SEEDS = (str, bytes, Mapping, Iterator)


def vector_options(options: Mapping[str, Any] | None, rough: bool, more: tuple[str, ...] = ()) -> dict[str, Any]:
    """Checked reset options of a vector environment, which takes whole maps by `set_terrains` alone."""
    given = checked_options(options, rough, more)
    for key in ("heightfield", "perceived", "terrain_residual"):
        if key in given:
            raise InputError(f"option {key!r}: a vector environment takes maps by set_terrains(maps, perceived)")
    return given


def autoreset_of(mode: Any) -> AutoresetMode:
    """A mode, or that of a value; what is neither raises `InputError` with the values that there are."""
    try:
        return AutoresetMode(mode)
    except ValueError:
        values = ", ".join(each.value for each in AutoresetMode)
        raise InputError(f"autoreset_mode is {mode!r}, want one of: {values}") from None


def ids_of(mask: Any, n: int) -> Ids:
    """Which of n environments a reset mask names; None is all."""
    if mask is None:
        return np.arange(n)
    mask = np.asarray(mask)
    if mask.shape != (n,) or mask.dtype != bool or not mask.any():
        raise InputError(f"reset_mask is {mask.dtype} {mask.shape}; want ({n},) bool with at least one True")
    return np.flatnonzero(mask)


def seeds_of(seed: int | Iterable[int | None] | None, n: int) -> list[int | None]:
    """A seed for each of n environments: s gives s, s + 1, ...; None leaves a generator as it is.

    Args:
      seed: a whole number or None, or anything that holds n of them: a list, a range, an array.
      n: environments.

    Raises:
      InputError: it is neither, or holds another number of seeds, or something that is no whole number.
    """
    if seed is None:
        return [None] * n
    if (one := whole(seed)) is not None:
        return [one + i for i in range(n)]
    if not isinstance(seed, Iterable) or isinstance(seed, _NO_SEEDS) or getattr(seed, "ndim", 1) == 0:
        raise InputError(f"seed is {seed!r}, want a whole number, or one for each of {n} environments")
    given = list(seed)
    if len(given) != n:
        raise InputError(f"seed is {seed!r}, which holds {len(given)} seeds, want one for each of {n} environments")
    seeds = [whole(s) for s in given]
    for i, (own, s) in enumerate(zip(seeds, given, strict=True)):
        if own is None and s is not None:
            raise InputError(f"seed[{i}] is {s!r}, want a whole number, or None for a generator to stay as it is")
    return seeds


def whole(value: Any) -> int | None:
    """A whole number of any library's as Python's own; None for what is none."""
    try:
        return operator.index(value)
    except TypeError:
        return None


def rows_of(value: Any, ids: Ids, n: int, name: str) -> Any:
    """A reset option of n environments, for some of them: an (n, ...) array is cut, anything else holds for each.

    Of psi an array of one dimension is one for all, even if there are as many environments as parameters.
    """
    if isinstance(value, Mapping):
        each = {k: numbers(v, f"{name}[{k!r}]") for k, v in value.items()}
        return {k: v[ids] if v.shape == (n,) else v for k, v in each.items()}
    numbers(value, name)  # refuses what is none
    array = np.asarray(value)
    one_for_all = array.ndim == 1 and name != "terrain_id"
    return array[ids] if array.shape[:1] == (n,) and not one_for_all else array


def terrain_ids(chosen: Any, k: int, maps: int) -> Ids:
    """(k,) map of each environment."""
    chosen = np.asarray(chosen)
    numeric = chosen.dtype.kind in "iuf" and np.isfinite(chosen).all()
    if chosen.shape not in ((), (k,)) or not numeric or (chosen % 1 != 0).any():
        raise InputError(
            f"terrain_id has shape {chosen.shape} and type {chosen.dtype}; want whole numbers () or ({k},)"
        )
    if (chosen < 0).any() or (chosen >= maps).any():
        raise InputError(f"terrain_id reaches from {chosen.min()} to {chosen.max()}, want 0 to {maps - 1}")
    return np.broadcast_to(chosen.astype(np.intp), (k,))


def masked(info: dict[str, Any], mask: NDArray[np.bool_]) -> dict[str, Any]:
    """Gymnasium's vector form of `info`: beside each key its mask, `_key`, of the environments that it is of."""
    return info | {"_" + key: mask for key in info}


def final_info(last: Any, info: dict[str, Any], new: dict[str, Any], done: NDArray[np.bool_]) -> dict[str, Any]:
    """What a same-step autoreset changes in `info`: the ended episodes' last words, and the new ones' first.

    Args:
      last: the last observations, (k, ...) or a dict of such, of the environments that are done.
      info: of the step.
      new: of the reset, for all.
      done: (n,) whose episodes ended.
    """
    own = {key: value for key, value in info.items() if not key.startswith("_")}
    observations = np.full(len(done), None, object)
    for row, i in enumerate(np.flatnonzero(done)):
        observations[i] = {k: v[row] for k, v in last.items()} if isinstance(last, dict) else last[row]
    ended = {key: value * done for key, value in own.items()}  # zero where no episode ended
    out: dict[str, Any] = {key: np.where(done, new[key], value) for key, value in own.items()}
    out |= {"final_obs": observations, "final_info": masked(ended, done)}
    return out | {"_final_obs": done, "_final_info": done}
