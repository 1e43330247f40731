"""Where wrappers draw from: a posterior, samples of a `Fidelity`, an array, or the path of a file with either."""

import os
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nfc_gym.core.errors import InputError
from nfc_gym.core.fidelity import Fidelity
from nfc_gym.core.posterior import Sampler, load_source, without_maps
from nfc_gym.physics.parameters import numbers

Array = NDArray[np.float64]
Source = Sampler | ArrayLike | str | os.PathLike[str]


class Draws:
    """Draws of one part of a fidelity.

    Args:
      source: a `Posterior` (or anything with its `sample`), a `Fidelity`, an array of one sample or of many, or a path.
      part: psi, delta_s or delta_e.
      who: named in errors.

    Attributes:
      shape: of one draw.

    Raises:
      InputError: the source is none of these, says nothing of the part, or holds values that are not finite.
    """

    def __init__(self, source: Source, part: str, who: str) -> None:
        self.part, self.who = part, who
        self.sampler = sampler_of(source, part, who)
        if part != "delta_e":
            self.sampler = without_maps(self.sampler)
        # One draw of its own generator shows what the source gives before any episode depends on it.
        self.shape = self.draw(1, np.random.default_rng(0)).shape[1:]

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """(n, *shape) draws."""
        fidelity = self.sampler.sample(n, rng)
        if not isinstance(fidelity, Fidelity):
            raise InputError(
                f"{self.who}: the source's sample(n, rng) must return a Fidelity, such as "
                f"Fidelity({self.part}=array), got {type(fidelity).__name__}"
            )
        value = getattr(fidelity, self.part)
        if value is None:
            given = ", ".join(fidelity.given) or "nothing"
            raise InputError(f"{self.who}: the source says nothing of {self.part}; it speaks of {given}")
        if len(value) != n:
            raise InputError(
                f"{self.who}: the source gave {len(value)} samples of {self.part} where {n} were asked for"
            )
        return value

    def expect(self, *shapes: tuple[int, ...], meaning: str) -> None:
        """Refuse draws of another shape than one of `shapes`."""
        if self.shape not in shapes:
            want = " or ".join(map(str, shapes))
            raise InputError(f"{self.who}: the source's {self.part} has shape {self.shape}; want {want}, {meaning}")


def sampler_of(source: Any, part: str, who: str) -> Sampler:
    """What to draw from; an array is samples of `part`. Raises `InputError` where `source` is nothing of the kind."""
    if isinstance(source, str | os.PathLike):
        return load_source(os.fspath(source))
    if isinstance(source, Sampler) and not isinstance(source, np.ndarray):
        return source
    try:
        array = numbers(source, part)
    except InputError:
        array = np.array(np.nan)
    if not array.ndim:  # nothing that has one number alone is a sample
        raise InputError(
            f"{who}: a source is a posterior with sample(n, rng), an array of numbers or a path, got {source!r}"
        )
    if array.ndim > 1 and not len(array):
        raise InputError(f"{who}: the source holds no sample, {array.shape}; want one of {part} or more")
    return Fidelity(**{part: array})
