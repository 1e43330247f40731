"""What a posterior says of a machine before anything is fitted: where to begin, and what to set beside the fit."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.posterior import Sampler, load_source, without_maps
from nfc_gym.physics.parameters import ParameterSpace

Array = NDArray[np.float64]
_DRAWS = 400
_TAILS = (0.05, 0.5, 0.95)


@dataclass(frozen=True)
class Belief:
    """Draws of a posterior that was given a window of this machine's motion.

    Attributes:
      file: where it was kept.
      names: declared parameters that it speaks of.
      draws: (n, k) of these, within their bounds.
      beyond: parameters that it speaks of and the mapping does not declare.
      delta_s: (n, s) residual of one control step, or None.
      states: what the entries of delta_s are of, where it says so.
    """

    file: str
    names: tuple[str, ...]
    draws: Array
    beyond: tuple[str, ...] = ()
    delta_s: Array | None = None
    states: tuple[str, ...] = ()

    def psi(self, space: ParameterSpace) -> Array:
        """(1 + n, d) vectors of a space: the median, then the draws; what it does not speak of is nominal."""
        rows = np.concatenate([np.median(self.draws, 0, keepdims=True), self.draws])
        out = np.repeat(space.nominal[None], len(rows), 0)
        out[:, [space.names.index(n) for n in self.names]] = rows
        return out

    def inferred(self) -> dict[str, dict[str, float]]:
        """Median and 90 % interval of each parameter."""
        return {n: _told(self.draws[:, i]) for i, n in enumerate(self.names)}

    def residual(self) -> list[dict[str, Any]]:
        """The same of each entry of delta_s, the ones that are surest not to be zero first."""
        if self.delta_s is None:
            return []
        names = self.states or tuple(f"entry {i}" for i in range(self.delta_s.shape[1]))
        spread = np.maximum(self.delta_s.std(0), 1e-300)
        order = np.argsort(-np.abs(np.median(self.delta_s, 0)) / spread, kind="stable")
        return [{"state": names[i]} | _told(self.delta_s[:, i]) for i in order]


def _told(draws: Array) -> dict[str, float]:
    return dict(zip(("low", "median", "high"), np.quantile(draws, _TAILS).tolist(), strict=True))


def read_belief(path: Path, space: ParameterSpace, seed: int) -> Belief:
    """Draw from the posterior that a file holds: `.safetensors` given a window, or an `.npz` of draws.

    A posterior says which parameters it is of; draws in an `.npz` must be of all declared ones, in their order.

    Args:
      path: what `nfc-gym infer --out` wrote.
      space: the declared parameters.
      seed: of the draws.

    Raises:
      InputError: no posterior, one that was given no window, or of other parameters or units than declared.
    """
    source: Any = load_source(path)
    if not isinstance(source, Sampler):
        raise InputError(f"{path}: {type(source).__name__} is no posterior; want what `nfc-gym infer --out` wrote")
    source = without_maps(source)  # logs hold no ground
    drawn = source.sample(_DRAWS, np.random.default_rng(seed))
    if drawn.psi is None:
        raise InputError(f"{path}: says nothing of psi")
    prior = getattr(source, "prior", None)
    names = tuple(space.names if prior is None else prior.names)
    if drawn.psi.shape[1] != len(names):
        raise InputError(f"{path}: draws of {drawn.psi.shape[1]} parameters; declared are {', '.join(names)}")
    own = [n for n in names if n in space.names]
    if not own:
        raise InputError(
            f"{path}: a posterior of {', '.join(names[:5])}, ...; none of these is declared: {', '.join(space.names)}"
        )
    if prior is not None:
        _require_units(path, dict(zip(names, prior.units, strict=True)), space)
    at = [space.names.index(n) for n in own]
    draws = np.clip(drawn.psi[:, [names.index(n) for n in own]], space.low[at], space.high[at])
    states = tuple(getattr(source, "notes", {}).get("states", ()))
    beyond = tuple(n for n in names if n not in own)
    return Belief(path.name, tuple(own), draws, beyond, drawn.delta_s, states)


def _require_units(path: Path, units: dict[str, str], space: ParameterSpace) -> None:
    odd = [p for p in space.parameters if p.name in units and units[p.name] != p.unit]
    if odd:
        raise InputError(
            f"{path}: {odd[0].name} is in {units[odd[0].name]!r} there and in {odd[0].unit!r} in the mapping"
        )
